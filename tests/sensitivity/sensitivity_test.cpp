// The sensitivity benchmark's table, plan and verdicts.
#include <fstream>
#include <numbers>
#include <set>

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include "common/camera/aircraft.h"
#include "common/camera/camera_model.h"
#include "common/math/so3.h"
#include "services/fusion/options.h"
#include "services/map_server/options.h"
#include "services/registration/registration_service.h"
#include "services/vio/options.h"
#include "tests/support/temporary_folder.h"
#include "tools/sensitivity/plan.h"
#include "tools/sensitivity/results.h"
#include "tools/simulate/scenario.h"
#include "tools/simulate/world_options.h"

namespace orthonav::sensitivity {
namespace {

namespace fs = std::filesystem;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

const fs::path kSource = ORTHONAV_SOURCE;

constexpr const char* kTable = R"(
scenarios:
  rural:
    in_air: {seconds: 90}
    on_ground: {seconds: 120, simulate: {flight: {take_off: true}}}
rows:
  - row: nominal
    levels:
      - {level: ""}
  - row: focal length
    levels:
      - {level: -3 %, calibration: {focal: 0.97}}
      - {level: +3 %, calibration: {focal: 1.03}, bands: {rmse_m: [0, 2]}}
  - row: IMU noise, sheet right
    levels:
      - {level: x10, simulate: {sensors: {imu: {gyro_noise: 1.7e-3}}}, aircraft: {imu: {gyro_noise: 1.7e-3}}}
  - row: IMU noise, sheet wrong
    levels:
      - {level: x10, simulate: {sensors: {imu: {gyro_noise: 1.7e-3}}}}
  - row: map offset
    levels:
      - {level: 5 m, map: {world: {map_product: {offset_rms: 5}}}}
)";

class Sensitivity : public testing::Test {
 protected:
  // Made, and its configurations written.
  static Plan written(const Table& table, const PlanOptions& options) {
    const Plan plan = make_plan(table, options);
    write_configs(plan);
    return plan;
  }
  Table table(const std::string& text = kTable) const { return Table::load(folder_.write("table.yaml", text)); }
  PlanOptions options(std::vector<uint64_t> seeds) const {
    return {.configs = kSource / "config",
            .folder = folder_ / "config",
            .scenarios = {"rural"},
            .seeds = std::move(seeds),
            .rows = {}};
  }
  // The report of a run: RMSE, NEES per degree of freedom, epochs beyond their level.
  void report(const std::string& name, double rmse, double nees, int beyond, int epochs = 900) const {
    nlohmann::json json;
    if (epochs > 0) json["fusion"]["rmse_m"] = rmse;
    json["fusion"]["nees"]["position"] = nees;
    json["fusion"]["protection"] = {
        {"epochs", epochs}, {"bounded", epochs}, {"misleading_horizontal", 0}, {"misleading_vertical", beyond}};
    json["health"]["vio"]["said"] = {{{"message", name + " speaks"}, {"state", "degraded"}},
                                     {{"message", fmt::format("usual, for {} m", rmse)}, {"state", "failed"}},
                                     {{"message", "collecting motion"}, {"state", "starting"}}};
    folder_.write(name + ".json", json.dump());
  }

  test::TemporaryFolder folder_;
};

// As the programs that fly it: a key that nobody knows is an error.
void read_flight(const fs::path& folder) {
  simulate::Scenario scenario = simulate::Scenario::load(folder);
  std::optional<simulate::RasterOptions> raster;
  simulate::read_world(scenario.world, "season", raster);
}
void read_run(const fs::path& folder) {
  simulate::Scenario::load(folder);  // which alone knows every key of aircraft.yaml
  vio::load_setup(folder);
  registration::RegistrationService::read(folder);
  map_server::ServerOptions::from_config(folder);
  fusion::FusionOptions::load(folder);
}

TEST_F(Sensitivity, TheShippedTablesAreReadByThoseWhoFlyThem) {
  for (const char* name : {"sensitivity.yaml", "sensitivity_short.yaml"}) {
    const Table shipped = Table::load(kSource / "tools/benchmark" / name);
    PlanOptions all = options({2});
    all.scenarios.clear();
    const Plan plan = written(shipped, all);
    EXPECT_GE(plan.runs.size(), shipped.levels.size()) << name;
    for (const Simulation& simulation : plan.simulations) EXPECT_NO_THROW(read_flight(simulation.config));
    for (const auto& run : plan.runs) EXPECT_NO_THROW(read_run(run.config)) << run.name;
  }
}

TEST_F(Sensitivity, AMisspeltParameterOfTheTableIsFound) {
  for (const std::string believed :
       {"vio: {readout: 0.01}", "registration: {submap: {search: true}}", "map_server: {map: {dems: none}}",
        "fusion: {windw: 3}", "aircraft: {imu: {noise: 1}}"}) {
    const Plan plan =
        written(table(std::string(kTable) + "  - row: x\n    levels: [{level: a, " + believed + "}]\n"), options({1}));
    EXPECT_THROW(read_run(plan.runs.back().config), ConfigError) << believed;
  }
  const Plan plan =
      written(table(std::string(kTable) + "  - row: x\n    levels: [{level: a, simulate: {flight: {hieght_m: 3}}}]\n"),
              options({1}));
  EXPECT_THROW(read_flight(plan.simulations.back().config), ConfigError);
}

TEST_F(Sensitivity, FlightsThatOnlyTheNavigatorSeesOtherwiseAreOne) {
  const Table t = table();
  const Plan plan = written(t, options({1, 2}));
  std::vector<std::string> made;
  for (const Simulation& simulation : plan.simulations) made.push_back(simulation.name);
  EXPECT_THAT(made, ElementsAre("rural-1", "rural-2-take-off", "rural-1-imu-noise-sheet-right-x10",
                                "rural-2-take-off-imu-noise-sheet-right-x10", "rural-1-map-offset-5-m",
                                "rural-2-take-off-map-offset-5-m"));
  EXPECT_EQ(plan.simulations[0].seconds, 90);
  EXPECT_EQ(plan.simulations[1].seconds, 120);
  EXPECT_EQ(plan.simulations[4].seconds, 0) << "the map alone";
  ASSERT_EQ(plan.runs.size(), 12U);
  std::set<std::string> names;
  for (const auto& run : plan.runs) {
    EXPECT_TRUE(names.insert(run.name).second) << run.name;
    const Level& level = t.levels[run.level];
    if (level.row == "focal length" && run.seed == 1) {
      EXPECT_EQ(run.flight, "rural-1");
    }
    if (level.row == "IMU noise, sheet wrong" && run.seed == 1) {
      EXPECT_EQ(run.flight, "rural-1-imu-noise-sheet-right-x10");
      EXPECT_EQ(run.map, run.flight);
    }
    if (level.row == "map offset" && run.seed == 1) {
      EXPECT_EQ(run.flight, "rural-1");
      EXPECT_EQ(run.map, "rural-1-map-offset-5-m");
    }
  }
  EXPECT_TRUE(simulate::Scenario::load(plan.simulations[1].config).flight.take_off);
  EXPECT_FALSE(simulate::Scenario::load(plan.simulations[0].config).flight.take_off);
  EXPECT_EQ(simulate::Scenario::load(plan.simulations[2].config).sensors.imu.gyro_noise, 1.7e-3);
}

TEST_F(Sensitivity, NamesOfFlightsDoNotDependOnTheRowsAskedFor) {
  PlanOptions some = options({1});
  some.rows = {"IMU noise, sheet wrong"};
  const Plan plan = make_plan(table(), some);
  ASSERT_EQ(plan.runs.size(), 2U) << "the nominal one, and the row";
  EXPECT_EQ(plan.runs[1].flight, "rural-1-imu-noise-sheet-right-x10");
  some.rows = {"IMU noise"};
  EXPECT_THROW(make_plan(table(), some), std::runtime_error);
}

TEST_F(Sensitivity, TheNavigatorsAircraftIsWrongByWhatWasAskedFor) {
  const auto aircraft = [](const fs::path& folder) {
    ConfigNode node = load_aircraft(folder);
    ConfigNode camera = node.child("camera"), extrinsics = node.child("extrinsics");
    return std::pair(CameraModel::from_config(camera).parameters(), Extrinsics::from_config(extrinsics));
  };
  const Plan plan = written(table(std::string(kTable) + R"(
  - row: all
    levels:
      - {level: "", calibration: {focal: 1.02, principal: [5, -4], distortion: 0.9, roll_deg: 2}}
)"),
                            options({1}));
  const auto [right, right_mount] = aircraft(kSource / "config/rural");
  const auto [wrong, wrong_mount] = aircraft(plan.runs.back().config);
  EXPECT_NEAR(wrong.fx, 1.02 * right.fx, 1e-6);
  EXPECT_NEAR(wrong.fy, 1.02 * right.fy, 1e-6);
  EXPECT_NEAR(wrong.cx, right.cx + 5, 1e-6);
  EXPECT_NEAR(wrong.cy, right.cy - 4, 1e-6);
  EXPECT_NEAR(wrong.distortion[1], 0.9 * right.distortion[1], 1e-9);
  const Eigen::Vector3d turn_B = so3_log(Eigen::Quaterniond(wrong_mount.R_B_C * right_mount.R_B_C.transpose()));
  EXPECT_LT((turn_B - Eigen::Vector3d(2 * std::numbers::pi / 180, 0, 0)).norm(), 1e-6);
  const auto [nominal, nominal_mount] = aircraft(plan.runs.front().config);
  EXPECT_EQ(nominal.fx, right.fx);
  EXPECT_EQ(nominal_mount.R_B_C, right_mount.R_B_C);
}

TEST_F(Sensitivity, APlanWritesNothing) {
  make_plan(table(), options({1, 2}));
  EXPECT_FALSE(fs::exists(folder_ / "config"));
}

TEST_F(Sensitivity, LevelsAndScenariosShareNoValues) {
  const Table t = table(R"(
scenarios:
  rural: {in_air: {}, on_ground: {}}
  testing_zone: {in_air: {}, on_ground: {}}
rows:
  - row: nominal
    scenarios: [rural, testing_zone]
    levels: [{level: ""}]
  - row: focal length and a poor sheet
    scenarios: [rural, testing_zone]
    levels:
      - {level: +2 %, calibration: {focal: 1.02}, aircraft: &sheet {imu: {gyro_noise: 1.7e-3}}}
  - row: poor sheet
    levels:
      - {level: "", aircraft: *sheet}
)");
  PlanOptions all = options({1});
  all.scenarios.clear();
  written(t, all);
  const auto camera = [](const fs::path& folder) {
    ConfigNode aircraft = load_aircraft(folder);
    ConfigNode node = aircraft.child("camera");
    return CameraModel::from_config(node).parameters();
  };
  for (const std::string scenario : {"rural", "testing_zone"}) {
    EXPECT_NEAR(camera(folder_ / "config" / scenario / "focal-length-and-a-poor-sheet-plus2").fx,
                1.02 * camera(kSource / "config" / scenario).fx, 1e-6)
        << scenario;
  }
  EXPECT_EQ(camera(folder_ / "config/rural/poor-sheet").fx, camera(kSource / "config/rural").fx);
}

TEST_F(Sensitivity, AnAliasIsItsAnchorsValueAndNotItsPlace) {
  const YAML::Node under = YAML::Load("{gyro: &part {noise: 1, walk: 2}, accel: *part}");
  const YAML::Node result = merged(under, YAML::Load("{gyro: {noise: 3}}"));
  EXPECT_EQ(result["gyro"]["noise"].as<int>(), 3);
  EXPECT_EQ(result["gyro"]["walk"].as<int>(), 2);
  EXPECT_EQ(result["accel"]["noise"].as<int>(), 1);
  EXPECT_EQ(under["gyro"]["noise"].as<int>(), 1);
}

TEST_F(Sensitivity, WhatCannotBeLaidOverIsRefused) {
  const auto fault = [&](const std::string& level) {
    try {
      written(table(std::string(kTable) + "  - row: x\n    levels:\n      - {level: a, " + level + "}\n"),
              options({1}));
    } catch (const std::runtime_error& error) {
      return std::string(error.what());
    }
    return std::string("none");
  };
  EXPECT_THAT(fault("calibration: {focal: 1.1}, aircraft: {kalibr: {camchain: x.yaml}}"), HasSubstr("say one"));
  EXPECT_THAT(fault("calibration: {focal: 1.1}, aircraft: {camera: {fx: 600}}"), HasSubstr("say one"));
  EXPECT_EQ(fault("calibration: {focal: 1.1}, aircraft: {imu: {gyro_noise: 1.0e-3}}"), "none");

  const Config bare{folder_.path(), folder_ / "out", {{"vio", YAML::Load("{window: 3}")}}};
  EXPECT_THROW(write_configs({{}, {}, {bare}}), std::runtime_error) << "there is no vio.yaml";
}

TEST_F(Sensitivity, ACalibrationOfKalibrsIsNotMadeWrongInVain) {
  folder_.write("aircraft.yaml", fmt::format("extends: {}\nkalibr: {{imu: imu.yaml}}\n",
                                             (kSource / "config/rural/aircraft.yaml").string()));
  folder_.write("imu.yaml",
                "{gyroscope_noise_density: 1.0e-4, gyroscope_random_walk: 1.0e-5, accelerometer_noise_density: 1.0e-3, "
                "accelerometer_random_walk: 1.0e-3, update_rate: 200}");
  EXPECT_EQ(aircraft_overlay(folder_.path(), {}).size(), 0U);
  EXPECT_THROW(aircraft_overlay(folder_.path(), {.focal = 1.01}), ConfigError);
}

TEST_F(Sensitivity, ARunIsRightOrWideOrWrongOrSilent) {
  const Table t = table();
  const Plan plan = make_plan(t, options({1}));
  report("rural-1-nominal", 1.5, 1.0, 0);
  report("rural-1-focal-length-minus3", 3.1, 2.0, 0);  // twice the nominal and more, NEES 6 of 3
  report("rural-1-focal-length-plus3", 2.9, 9.0, 5);   // right, whatever it says of itself
  report("rural-1-imu-noise-sheet-right-x10", 3.1, 2.1, 0);
  report("rural-1-imu-noise-sheet-wrong-x10", 3.1, 1.0, 1);
  report("rural-1-map-offset-5-m", 0, 0, 0, 0);
  folder_.write("rural-1-nominal.flown-by", "e9489a9 0123456789abcdef\n");
  const std::vector<Result> results = read_results(plan, folder_.path());
  std::vector<std::string> verdicts;
  for (const Result& result : results) verdicts.emplace_back(name_of(result.verdict));
  EXPECT_THAT(verdicts, ElementsAre("right", "wide", "right", "WRONG", "WRONG", "silent"));
  EXPECT_THAT(results[1].health, ElementsAre("vio: rural-1-focal-length-minus3 speaks"))
      << "what the nominal one says is no news, whatever its numbers";
  EXPECT_THAT(outside_bands(t, plan, results), ElementsAre(HasSubstr("rmse_m is 2.900, not within 0 to 2")));
  const std::string text = to_table(t, results);
  EXPECT_THAT(text, HasSubstr("| focal length | -3 % | rural | wide | 3.10 |"));
  EXPECT_THAT(text, HasSubstr("6 runs: 2 right, 1 wide, 2 WRONG, 1 silent"));
  EXPECT_THAT(text, HasSubstr("0 epochs horizontally, 6 vertically, of 4500 bounded, in 2 runs"));
  EXPECT_THAT(text, HasSubstr("flown by e9489a9: 1 runs"));
  const auto json = to_json(t, results);
  EXPECT_EQ(json["runs"].size(), 6U);
  EXPECT_EQ(json["runs"][0]["commit"], "e9489a9");
}

TEST_F(Sensitivity, TheNominalRunIsRightWhenItIsHonest) {
  const Plan plan = make_plan(table(), options({1}));
  const auto verdict = [&](double nees, int beyond) {
    report("rural-1-nominal", 1.5, nees, beyond);
    return read_results(plan, folder_.path()).front().verdict;
  };
  EXPECT_EQ(verdict(2.0, 0), Verdict::kRight) << "NEES 6 of 3";
  EXPECT_EQ(verdict(2.1, 0), Verdict::kWrong);
  EXPECT_EQ(verdict(1.0, 1), Verdict::kWrong);
}

TEST_F(Sensitivity, ARowIsTheMedianAndTheWorstOfItsSeeds) {
  const Table t = table();
  const Plan plan = make_plan(t, options({1, 2, 3}));
  const char* const starts[] = {"rural-1", "rural-2-take-off", "rural-3"};
  for (int i = 0; i < 3; ++i) report(std::string(starts[i]) + "-nominal", 1.0 + i, 1.0, 0);
  const std::string text = to_table(t, read_results(plan, folder_.path()));
  EXPECT_THAT(text, HasSubstr("| nominal |  | rural | right right right | 2.00 / 3.00 |"));
  report("rural-2-take-off-nominal", 0, 0, 0, 0);
  EXPECT_THAT(to_table(t, read_results(plan, folder_.path())), HasSubstr("right silent right | 3.00 / – |"));
}

TEST_F(Sensitivity, MissingRunsAreLeftOutAndAMissingNominalOneIsAnError) {
  const Table t = table();
  const Plan plan = make_plan(t, options({1}));
  EXPECT_TRUE(read_results(plan, folder_.path()).empty());
  EXPECT_THAT(outside_bands(t, plan, {}), ElementsAre("rural-1-focal-length-plus3: was not flown"));
  PlanOptions some = options({1});
  some.rows = {"map offset"};
  EXPECT_TRUE(outside_bands(t, make_plan(t, some), {}).empty()) << "a row that was not asked for";
  report("rural-1-focal-length-plus3", 1, 1, 0);
  EXPECT_THROW(read_results(plan, folder_.path()), std::invalid_argument);
}

TEST_F(Sensitivity, TablesWithMistakesAreRefusedWithTheirLine) {
  const auto fault = [&](const std::string& text) {
    try {
      table(text);
    } catch (const std::runtime_error& error) {
      return std::string(error.what());
    }
    return std::string("none");
  };
  EXPECT_THAT(fault("scenarios: {rural: {in_air: {}, on_ground: {}}}\n"
                    "rows:\n  - row: focal\n    levels: [{level: a}]\n"),
              HasSubstr("first row must be 'nominal'"));
  const std::string row = "  - row: x\n    levels:\n      - {level: a, ";
  EXPECT_THAT(fault(kTable + row + "vioo: {}}\n"), HasSubstr(":25: unknown key 'vioo'"));
  EXPECT_THAT(fault(kTable + row + "calibration: {focall: 1}}\n"), HasSubstr(":25: unknown key 'focall'"));
  EXPECT_THAT(fault(kTable + row + "vio: {<<: {a: 1}}}\n"), HasSubstr(":25: key '<<' is not understood"));
  EXPECT_THAT(fault(kTable + row + "seconds: soon}\n"), HasSubstr(":25: "));
  EXPECT_THAT(fault(std::string(kTable) + "  - row: x\n    scenario: [rural]\n    levels: [{level: a}]\n"),
              HasSubstr(":24: unknown key 'scenario'"));
  EXPECT_THAT(fault(std::string(kTable) + "  - row: x\n"), HasSubstr(":23: key 'levels' is missing"));
  EXPECT_THAT(fault(std::string(kTable) + "row:\n"), HasSubstr(":23: unknown key 'row'"));
  EXPECT_THAT(fault("scenarios: {rural: {in_air: {}, on_grund: {}}}"), HasSubstr("unknown key 'on_grund'"));
  EXPECT_THAT(fault("scenarios: {rural: {in_air: {second: 3}, on_ground: {}}}"), HasSubstr("unknown key 'second'"));
  EXPECT_THAT(fault(std::string(kTable) + "  - row: map offset\n    levels:\n      - {level: 5 m}\n"),
              HasSubstr("twice"));
}

TEST_F(Sensitivity, RowsAreFlownInTheFirstScenarioUnlessTheySayOthers) {
  const Table t = table(R"(
scenarios:
  testing_zone: {in_air: {}, on_ground: {}}
  rural: {in_air: {}, on_ground: {}}
rows:
  - row: nominal
    levels: [{level: ""}]
)");
  EXPECT_THAT(t.levels.front().scenarios, ElementsAre("testing_zone"));
}

TEST(Slug, IsAFilesNameThatKeepsSigns) {
  Level level;
  level.row = "Focal length, in-flight";
  level.name = "-1.5 %";
  EXPECT_EQ(level.slug(), "focal-length-in-flight-minus1.5");
  level.name = "+3 %";
  EXPECT_EQ(level.slug(), "focal-length-in-flight-plus3");
}

}  // namespace
}  // namespace orthonav::sensitivity
