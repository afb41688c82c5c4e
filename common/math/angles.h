#pragma once

#include <numbers>

namespace orthonav {

inline constexpr double kDegree = std::numbers::pi / 180.0;  // rad

}  // namespace orthonav
