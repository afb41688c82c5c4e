#include "tools/evaluate/tum.h"

#include <fstream>
#include <map>
#include <stdexcept>

#include <fmt/format.h>
#include <fmt/ostream.h>

namespace orthonav::evaluate {
namespace {

class TumFile {
 public:
  explicit TumFile(const std::filesystem::path& file) : file_(file), out_(file) {}
  void write(int64_t utime, const Eigen::Vector3d& p, const Eigen::Quaterniond& q) {
    fmt::print(out_, "{}.{:06d} {:.6f} {:.6f} {:.6f} {:.9f} {:.9f} {:.9f} {:.9f}\n", utime / 1'000'000,
               utime % 1'000'000, p.x(), p.y(), p.z(), q.x(), q.y(), q.z(), q.w());
  }
  void close() {
    out_.close();
    if (!out_) throw std::runtime_error(fmt::format("{}: cannot write", file_.string()));
  }

 private:
  std::filesystem::path file_;
  std::ofstream out_;
};

}  // namespace

void write_tum(const FlightRecord& record, const std::filesystem::path& folder) {
  std::filesystem::create_directories(folder);
  if (!record.truth.empty()) {
    TumFile file(folder / "truth.tum");
    for (const ReferenceSample& sample : record.truth.samples()) file.write(sample.utime, sample.p_G_B, sample.q_G_B);
    file.close();
  }
  std::map<int, std::vector<const vio_state_t*>> sessions;
  for (const auto& [logged_at, state] : record.vio) {
    if (state.status != vio_state_t::INITIALISING) sessions[state.session].push_back(&state);
  }
  const std::vector<const vio_state_t*>* longest = nullptr;
  for (const auto& [id, states] : sessions) {
    if (longest == nullptr || states.size() > longest->size()) longest = &states;
  }
  if (longest != nullptr) {
    TumFile file(folder / "vio.tum");
    for (const vio_state_t* state : *longest) {
      file.write(state->utime, vector_of(state->p_W_B), quaternion_of(state->q_W_B));
    }
    file.close();
  }
  if (record.frame && !record.nav.empty()) {
    TumFile file(folder / "fusion.tum");
    for (const auto& [logged_at, nav] : record.nav) {
      if (const auto p = position_of(*record.frame, nav)) file.write(nav.utime, *p, quaternion_of(nav.q_G_B));
    }
    file.close();
  }
}

}  // namespace orthonav::evaluate
