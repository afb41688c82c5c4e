#include "tools/sensitivity/miscalibration.h"

#include <vector>

#include "common/camera/aircraft.h"
#include "common/camera/camera_model.h"
#include "common/math/angles.h"
#include "common/math/so3.h"

namespace orthonav::sensitivity {

YAML::Node aircraft_overlay(const std::filesystem::path& folder, const Miscalibration& wrong) {
  YAML::Node overlay(YAML::NodeType::Map);
  if (wrong == Miscalibration()) return overlay;
  ConfigNode aircraft = load_aircraft(folder);
  // Kalibr's files win over what is laid over aircraft.yaml: the navigator would be right after all.
  if (aircraft.has("kalibr")) aircraft.fail("kalibr", "wins over a calibration that is wrong on purpose");
  ConfigNode camera_node = aircraft.child("camera"), extrinsics_node = aircraft.child("extrinsics");
  const CameraParameters camera = CameraModel::from_config(camera_node).parameters();
  const Extrinsics extrinsics = Extrinsics::from_config(extrinsics_node);

  if (wrong.focal != 1) {
    overlay["camera"]["fx"] = wrong.focal * camera.fx;
    overlay["camera"]["fy"] = wrong.focal * camera.fy;
  }
  if (wrong.principal_u != 0) overlay["camera"]["cx"] = camera.cx + wrong.principal_u;
  if (wrong.principal_v != 0) overlay["camera"]["cy"] = camera.cy + wrong.principal_v;
  if (wrong.distortion != 1) {
    std::vector<double> distortion;
    for (const double k : camera.distortion) distortion.push_back(wrong.distortion * k);
    overlay["camera"]["distortion"] = distortion;
  }
  const Eigen::Vector3d turn_B = kDegree * Eigen::Vector3d(wrong.roll_deg, wrong.pitch_deg, wrong.yaw_deg);
  if (!turn_B.isZero(0)) {
    const Eigen::Matrix<double, 3, 3, Eigen::RowMajor> R_B_C = so3_exp(turn_B).toRotationMatrix() * extrinsics.R_B_C;
    overlay["extrinsics"]["R_B_C"] = std::vector<double>(R_B_C.data(), R_B_C.data() + 9);
  }
  return overlay;
}

}  // namespace orthonav::sensitivity
