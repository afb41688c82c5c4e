#include "tools/simulate/scenario.h"

#include "common/camera/aircraft.h"
#include "common/math/angles.h"

namespace orthonav::simulate {

Scenario Scenario::load(const std::filesystem::path& folder) {
  ConfigNode simulate = ConfigNode::load(folder / "simulate.yaml");
  ConfigNode aircraft = load_aircraft(folder);
  ConfigNode flight_node = simulate.child_or_empty("flight");
  ConfigNode effects_node = simulate.child_or_empty("camera_effects");
  ConfigNode sensors_node = simulate.child_or_empty("sensors");
  ConfigNode camera_node = aircraft.child("camera");
  ConfigNode extrinsics_node = aircraft.child("extrinsics");
  ConfigNode imu_node = aircraft.child_or_empty("imu");

  Scenario scenario{.world = simulate.child_or_empty("world"),
                    .flight = FlightOptions::from_config(flight_node),
                    .camera_effects = CameraEffectOptions::from_config(effects_node),
                    .sensors = SensorOptions::from_config(sensors_node),
                    .camera = CameraModel::from_config(camera_node),
                    .extrinsics = Extrinsics::from_config(extrinsics_node),
                    .imu = {}};
  simulate.read("record_s", scenario.record_s, 0.0, 36000.0);
  simulate.require("start_unix_s", scenario.start_unix_s);
  simulate.finish();

  imu_node.read("gyro_noise", scenario.imu.gyro_noise, 0.0, 1.0);
  imu_node.read("gyro_walk", scenario.imu.gyro_walk, 0.0, 1.0);
  imu_node.read("accel_noise", scenario.imu.accel_noise, 0.0, 10.0);
  imu_node.read("accel_walk", scenario.imu.accel_walk, 0.0, 10.0);
  imu_node.read("rate_hz", scenario.imu.rate_hz, 10.0, 10000.0);
  imu_node.read("gravity", scenario.imu.gravity, 9.0, 10.0);
  imu_node.finish();
  double declination_deg = 0;
  aircraft.read("magnetic_declination_deg", declination_deg, -180.0, 180.0);
  scenario.magnetic_declination = declination_deg * kDegree;
  aircraft.finish();
  return scenario;
}

}  // namespace orthonav::simulate
