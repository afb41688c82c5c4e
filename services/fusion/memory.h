// What a fusion has to know to go on where another one was killed: the newest node of the graph with its covariance.
//
// On a chain the newest node's marginal holds all that the earlier ones say of what comes, so that nothing is lost but
// the protection level's history, fixes not believed, and fixes still to come of older keyframes. It is kept in a small
// file, replaced as a whole after each keyframe and fix. A file that is cut, altered or of another version is no
// memory.
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>

#include "services/fusion/pose_graph.h"
#include "services/fusion/types.h"

namespace orthonav::fusion {

struct Memory {
  Keyframe keyframe;          // of the newest node, without its relative covariance
  int64_t session_utime = 0;  // of the session's first keyframe
  Estimate estimate;          // of that node
  Geodetic anchor;            // of G
  int64_t newest_fix_utime = 0;
  int believed = 0;             // fixes since the lock,
  double most_told = kUnknown;  // the largest log-odds that one of them told, NaN: none did,
  double span = 0.0;            // and how far (agreement.h)
  int reset_counter = 0;
};

// Replaces the file. False, with the old file left as it was, where that cannot be done.
bool write_memory(const std::filesystem::path& file, const Memory& memory);
// nullopt where there is no such file or it is no memory. The numbers are as they were written; whether they make sense
// is the reader's to judge (Fusion::resume).
std::optional<Memory> read_memory(const std::filesystem::path& file);

}  // namespace orthonav::fusion
