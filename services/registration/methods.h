// All methods with their options: the one place that knows which there are.
#pragma once

#include <memory>

#include "services/registration/method.h"
#include "services/registration/paper/registrar.h"
#include "services/registration/submap/submap.h"

namespace orthonav::registration {

struct MethodOptions {
  RegistrarOptions registrar;  // its `method` says which
  SubmapOptions submap;

  // Reads `method` and what the methods have in registration.yaml. Throws ConfigError.
  static MethodOptions from_config(ConfigNode& node);
};

std::unique_ptr<Method> make_method(const MethodOptions& options, const CameraModel& camera);

}  // namespace orthonav::registration
