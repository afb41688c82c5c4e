# One function per kind of target, so that each part's CMakeLists.txt is a few lines.

option(ORTHONAV_WARNINGS_AS_ERRORS "Treat compiler warnings as errors" OFF)
option(ORTHONAV_FUZZ "Build the libFuzzer targets (clang only)" OFF)
set(ORTHONAV_SANITIZE "" CACHE STRING "Sanitizers to build with, as for -fsanitize=")

if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release CACHE STRING "" FORCE)
endif()

find_program(CCACHE_EXECUTABLE ccache)
if(CCACHE_EXECUTABLE)
  set(CMAKE_CXX_COMPILER_LAUNCHER ${CCACHE_EXECUTABLE})
endif()

if(ORTHONAV_SANITIZE)
  add_compile_options(-fsanitize=${ORTHONAV_SANITIZE} -fno-omit-frame-pointer -fno-sanitize-recover=all)
  add_link_options(-fsanitize=${ORTHONAV_SANITIZE})
  # g++ 12 looks for the type of the wrong object where a pointer to a member function is called, as LCM's header does
  # for every message; clang finds nothing there.
  add_compile_options($<$<CXX_COMPILER_ID:GNU>:-fno-sanitize=vptr>)
endif()

# How many times as long as in a release build a test may take: instrumented ones are five to twenty times slower.
set(ORTHONAV_TIME_FACTOR 1)
# Times real time, of flights through processes in tests: instrumented services need more than one second for each.
set(ORTHONAV_FLIGHT_SPEED 1)
if(ORTHONAV_SANITIZE)
  set(ORTHONAV_TIME_FACTOR 20)
  set(ORTHONAV_FLIGHT_SPEED 0.25)
endif()

if(ORTHONAV_FUZZ)
  add_compile_options(-fsanitize=fuzzer-no-link)
endif()

function(orthonav_compile_options target)
  target_compile_options(${target} PRIVATE
    -Wall -Wextra -Wpedantic -Wshadow -Wnon-virtual-dtor -Wold-style-cast -Wcast-qual
    -Woverloaded-virtual)
  if(ORTHONAV_WARNINGS_AS_ERRORS)
    target_compile_options(${target} PRIVATE -Werror)
  endif()
endfunction()

# orthonav_library(name SOURCES a.cpp ... LINKS lib ... [SYSTEM_LINKS lib ...])
# A static library; headers are included as "folder/file.h" from the top of the tree.
# SYSTEM_LINKS are third-party targets whose headers are not held to our warnings.
function(orthonav_library name)
  cmake_parse_arguments(ARG "" "" "SOURCES;LINKS" ${ARGN})
  if(ARG_SOURCES)
    add_library(${name} STATIC ${ARG_SOURCES})
    target_include_directories(${name} PUBLIC ${CMAKE_SOURCE_DIR})
    target_link_libraries(${name} PUBLIC ${ARG_LINKS})
    orthonav_compile_options(${name})
  else()
    add_library(${name} INTERFACE)
    target_include_directories(${name} INTERFACE ${CMAKE_SOURCE_DIR})
    target_link_libraries(${name} INTERFACE ${ARG_LINKS})
  endif()
endfunction()

# What a user runs, without tests and benchmarks.
add_custom_target(programs)

# orthonav_executable(name SOURCES main.cpp ... LINKS lib ...): a program in build/<preset>/bin.
function(orthonav_executable name)
  cmake_parse_arguments(ARG "" "" "SOURCES;LINKS" ${ARGN})
  add_executable(${name} ${ARG_SOURCES})
  target_link_libraries(${name} PRIVATE ${ARG_LINKS} CLI11::CLI11)
  orthonav_compile_options(${name})
  # Experiments and benchmarks stay in the build folder.
  if(name MATCHES "^orthonav-")
    install(TARGETS ${name} RUNTIME DESTINATION bin COMPONENT runtime)
    add_dependencies(programs ${name})
  endif()
endfunction()

# orthonav_test(name SOURCES a.cpp ... LINKS lib ... [LABELS ...] [TIMEOUT s] [FIXTURE f] [OWN_BUS] [LOSSY_BUS]
# [ALONE]): a GoogleTest program. Each of its tests is a ctest test of its own; with OWN_BUS, on an LCM bus of its own
# (deploy/own-bus), with LOSSY_BUS on one that loses packets (tests/support/lossy-bus); with FIXTURE, after the ctest fixture f; with ALONE, while no other test runs (real time). It says with exit code 77 that this machine does not permit it.
function(orthonav_test name)
  cmake_parse_arguments(ARG "OWN_BUS;LOSSY_BUS;ALONE" "TIMEOUT;FIXTURE" "SOURCES;LINKS;LABELS" ${ARGN})
  if(NOT ARG_TIMEOUT)
    set(ARG_TIMEOUT 120)
  endif()
  math(EXPR limit "${ARG_TIMEOUT} * ${ORTHONAV_TIME_FACTOR}")
  add_executable(${name} ${ARG_SOURCES} ${CMAKE_SOURCE_DIR}/tests/support/main.cpp)
  target_include_directories(${name} PRIVATE ${CMAKE_SOURCE_DIR})
  target_link_libraries(${name} PRIVATE ${ARG_LINKS} GTest::gmock)
  orthonav_compile_options(${name})
  set_target_properties(${name} PROPERTIES RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/tests)
  if(ARG_OWN_BUS)
    set_target_properties(${name} PROPERTIES CROSSCOMPILING_EMULATOR ${CMAKE_SOURCE_DIR}/deploy/own-bus)
  endif()
  if(ARG_LOSSY_BUS)
    set_target_properties(${name} PROPERTIES CROSSCOMPILING_EMULATOR ${CMAKE_SOURCE_DIR}/tests/support/lossy-bus)
  endif()
  include(GoogleTest)
  target_compile_definitions(${name} PRIVATE
    ORTHONAV_BIN="${CMAKE_BINARY_DIR}/bin" ORTHONAV_SOURCE="${CMAKE_SOURCE_DIR}"
    ORTHONAV_FLIGHT_SPEED=${ORTHONAV_FLIGHT_SPEED})
  gtest_discover_tests(${name} DISCOVERY_TIMEOUT 60
    PROPERTIES TIMEOUT ${limit} SKIP_RETURN_CODE 77 LABELS "${ARG_LABELS}" FIXTURES_REQUIRED "${ARG_FIXTURE}" RUN_SERIAL "${ARG_ALONE}")
endfunction()

# orthonav_script_test(name TIMEOUT s COMMAND program argument... [PROPERTIES property value ...]): a test that is a
# script; it says with exit code 77 that this machine does not permit it.
function(orthonav_script_test name)
  cmake_parse_arguments(ARG "" "TIMEOUT" "COMMAND;PROPERTIES" ${ARGN})
  add_test(NAME ${name} COMMAND ${ARG_COMMAND})
  math(EXPR limit "${ARG_TIMEOUT} * ${ORTHONAV_TIME_FACTOR}")
  set_tests_properties(${name} PROPERTIES TIMEOUT ${limit} SKIP_RETURN_CODE 77 ${ARG_PROPERTIES})
endfunction()
