// What a health message says, whatever its numbers: seconds and shares go on counting, what is news has other words.
#pragma once

#include <cctype>
#include <string>

namespace orthonav {

inline std::string wording(std::string message) {
  std::erase_if(message,
                [](char c) { return std::isdigit(static_cast<unsigned char>(c)) != 0 || c == '.' || c == '-'; });
  return message;
}

}  // namespace orthonav
