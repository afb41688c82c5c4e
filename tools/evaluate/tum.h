// Trajectories in the TUM format, "timestamp tx ty tz qx qy qz qw", which other evaluation tools read.
#pragma once

#include <filesystem>

#include "tools/evaluate/flight_record.h"

namespace orthonav::evaluate {

// Writes truth.tum, vio.tum (in W; of several sessions the longest) and fusion.tum, those that the log has, into
// `folder`, which is made. Times in seconds, metres in the record's frame. Throws std::runtime_error naming the file.
void write_tum(const FlightRecord& record, const std::filesystem::path& folder);

}  // namespace orthonav::evaluate
