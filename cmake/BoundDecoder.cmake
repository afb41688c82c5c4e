# Makes a decoder of lcm-gen check the lengths in a message against the bytes that are left of it:
#
#   cmake -D HEADER=.../map_tile_t.hpp -P BoundDecoder.cmake
#
# As generated it believes them: a string of negative length throws, and a message of 600 bytes that claims 10^8 features
# allocates gigabytes before their absence is noticed. Every element takes a byte at least.
file(READ ${HEADER} text)
string(REGEX REPLACE "if\\((__[a-z_]+_len__) > maxlen - pos\\)" "if(\\1 < 1 || \\1 > maxlen - pos)" text "${text}")
string(REGEX REPLACE "(this->[a-z_]+\\.resize\\((this->[a-z_]+)\\);)"
  "if(\\2 < 0 || \\2 > maxlen - pos) return -1;\n    \\1" text "${text}")
# Another lcm-gen may write them another way.
string(REGEX MATCHALL "_len__ - 1\\)|\\.resize\\(this->" believed "${text}")
string(REGEX MATCHALL "if\\([a-z_>-]+ < [01] \\|\\| " bounded "${text}")
list(LENGTH believed believed)
list(LENGTH bounded bounded)
if(NOT believed EQUAL bounded)
  message(FATAL_ERROR "${HEADER}: ${bounded} of ${believed} lengths are checked: lcm-gen has changed, see cmake/BoundDecoder.cmake")
endif()
file(WRITE ${HEADER} "${text}")
