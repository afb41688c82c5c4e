#include "services/registration/methods.h"

#include "services/registration/paper/paper_method.h"

namespace orthonav::registration {

MethodOptions MethodOptions::from_config(ConfigNode& node) {
  return {RegistrarOptions::from_config(node), SubmapOptions::from_config(node)};
}

std::unique_ptr<Method> make_method(const MethodOptions& options, const CameraModel& camera) {
  if (options.registrar.method == MethodName::kSubmap) return std::make_unique<SubmapRegistrar>(options.submap, camera);
  return std::make_unique<PaperMethod>(options.registrar, camera, options.submap.temperature);
}

}  // namespace orthonav::registration
