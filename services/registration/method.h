// A way of registering keyframes to the map: what the service asks of it, whichever it is.
//
//   submap  points of several keyframes together (submap/submap.h), the one orthonav ships with
//   paper   tracked points of one keyframe, equations (5)-(10); m1, m2: its two comparison methods (paper/)
//
// All of them put the places that they find to one belief about place (place_belief.h).
//
// Not thread-safe; deterministic.
#pragma once

#include <memory>
#include <optional>

#include <opencv2/core.hpp>

#include "common/camera/camera_model.h"
#include "services/registration/fix.h"
#include "services/registration/place_belief.h"
#include "services/registration/place_prior.h"
#include "services/registration/types.h"

namespace orthonav::registration {

enum class MethodName { kSubmap, kPaper, kM1, kM2 };
const char* name_of(MethodName method);
// Kind of map features it compares, as map_info_t names them.
const char* features_for(MethodName method);

class Method {
 public:
  Method() = default;
  Method(const Method&) = delete;
  Method& operator=(const Method&) = delete;
  virtual ~Method() = default;

  virtual bool has_map() const = 0;
  // A map, or another part or resolution of the same. Throws std::invalid_argument when it is empty or its features are
  // of another kind than the method needs.
  virtual void set_map(MapFeatures features, const MapGeometry& geometry) = 0;
  // Before a map with another G.
  virtual void clear_map() = 0;

  // Where a person says that the aircraft is, now: believed so far until the first fix.
  virtual void hint(const ExpectedArea& area) = 0;

  // The three stages of a keyframe, to be called in this order for each; separate so that the caller can time them.
  // `session` is the odometry's: another one begins anew. `image` is the raw grey image of its time; it is kept, not
  // copied: not to be changed afterwards. Throw std::logic_error without a map. The return value says whether the
  // keyframe can be used; why not is in the fix.
  virtual bool describe(const Keyframe& keyframe, int session, const cv::Mat& image, const Heading& heading) = 0;
  virtual void search(const std::optional<PositionPrior>& prior) = 0;
  virtual Fix solve() = 0;

  // What is believed of the place, after search().
  virtual const PlaceBelief& belief() const = 0;
};

}  // namespace orthonav::registration
