# Finds LCM as Debian packages it (no CMake config, no usable pkg-config file).
#
# Defines the imported target LCM::lcm, the program LCM_GEN_EXECUTABLE, and
#
#   lcm_add_cpp_types(TARGET PACKAGE pkg FILES a.lcm b.lcm ...)
#
# which makes TARGET an interface library that carries the generated C++ headers
# <pkg>/a.hpp, <pkg>/b.hpp, ..., whose decoders check lengths (BoundDecoder.cmake). A file may define one type, named
# like the file.

find_path(LCM_INCLUDE_DIR NAMES lcm/lcm-cpp.hpp)
find_library(LCM_LIBRARY NAMES lcm)
find_program(LCM_GEN_EXECUTABLE NAMES lcm-gen)

include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(LCM
  REQUIRED_VARS LCM_LIBRARY LCM_INCLUDE_DIR LCM_GEN_EXECUTABLE)
mark_as_advanced(LCM_INCLUDE_DIR LCM_LIBRARY LCM_GEN_EXECUTABLE)

if(LCM_FOUND AND NOT TARGET LCM::lcm)
  add_library(LCM::lcm UNKNOWN IMPORTED)
  set_target_properties(LCM::lcm PROPERTIES
    IMPORTED_LOCATION "${LCM_LIBRARY}"
    INTERFACE_INCLUDE_DIRECTORIES "${LCM_INCLUDE_DIR}")
endif()

function(lcm_add_cpp_types target)
  cmake_parse_arguments(ARG "" "PACKAGE" "FILES" ${ARGN})
  set(out ${CMAKE_CURRENT_BINARY_DIR}/include)
  set(headers)
  foreach(file IN LISTS ARG_FILES)
    get_filename_component(name ${file} NAME_WE)
    set(header ${out}/${ARG_PACKAGE}/${name}.hpp)
    add_custom_command(
      OUTPUT ${header}
      COMMAND ${LCM_GEN_EXECUTABLE} --cpp --cpp-hpath ${out} ${CMAKE_CURRENT_SOURCE_DIR}/${file}
      COMMAND ${CMAKE_COMMAND} -D HEADER=${header} -P ${CMAKE_SOURCE_DIR}/cmake/BoundDecoder.cmake
      DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/${file} ${CMAKE_SOURCE_DIR}/cmake/BoundDecoder.cmake
      COMMENT "lcm-gen ${file}"
      VERBATIM)
    list(APPEND headers ${header})
  endforeach()
  add_custom_target(${target}_generate DEPENDS ${headers})
  add_library(${target} INTERFACE)
  add_dependencies(${target} ${target}_generate)
  # SYSTEM: generated code is not held to the project's warnings.
  target_include_directories(${target} SYSTEM INTERFACE ${out})
  target_link_libraries(${target} INTERFACE LCM::lcm)
endfunction()
