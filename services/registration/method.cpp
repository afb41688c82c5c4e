#include "services/registration/method.h"

namespace orthonav::registration {

const char* name_of(MethodName method) {
  switch (method) {
    case MethodName::kSubmap:
      return "submap";
    case MethodName::kM1:
      return "m1";
    case MethodName::kM2:
      return "m2";
    case MethodName::kPaper:
      break;
  }
  return "paper";
}

const char* features_for(MethodName method) {
  if (method == MethodName::kSubmap) return "rootsift";
  return method == MethodName::kM2 ? "sift" : "grid";
}

}  // namespace orthonav::registration
