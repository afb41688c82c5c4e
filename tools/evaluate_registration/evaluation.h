// Registers photos to a map as registration would keyframes, without an odometry: corners of a photo are points of flat
// ground, placed by its true pose with the errors that compass and odometry would have.
#pragma once

#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "services/registration/paper/registrar.h"
#include "services/registration/submap/submap.h"
#include "tools/evaluate_registration/photo_folder.h"

namespace orthonav::evaluate_registration {

struct EvaluationOptions {
  bool submap = true;  // method submap; else that of `registrar`
  registration::RegistrarOptions registrar;
  registration::SubmapOptions submaps;
  int keyframes = 5;           // of a submap: the photo and those before it
  int spacing = 1;             // photos from one of them to the next
  int every = 1;               // photo that is evaluated
  int corners = 150;           // of a photo
  double heading_stddev = 0;   // rad, of the error given to the true heading
  double scale_stddev = 0;     // of the error given to the true scale
  double match_distance = 30;  // m: nearer is a true match
  unsigned seed = 1;           // of the errors
};

struct Outcome {
  std::string image;
  std::string refused;                                      // why there is no place; empty when there is one
  bool accepted = false;                                    // a valid fix
  double error = std::numeric_limits<double>::quiet_NaN();  // m, horizontal: of the fix, or of the place refused
  int num_inliers = 0;
  double milliseconds = 0;  // of the photo, those before it in a submap not counted
};

// Makes the corners of `grey` (at most `num_corners`) points of the keyframe, which has its pose and extrinsics: flat
// ground at z = 0 in W. Corners near the horizon are left out.
void add_flat_ground(const cv::Mat& grey, const CameraModel& camera, int num_corners, registration::Keyframe& keyframe);

// One outcome for each photo evaluated, in their order. Photos with a problem and files that are no pictures are
// outcomes with a reason. Throws std::invalid_argument when the map does not suit the method.
std::vector<Outcome> evaluate(const PhotoFolder& folder, const registration::MapFeatures& map,
                              const registration::MapGeometry& geometry, const EvaluationOptions& options);

}  // namespace orthonav::evaluate_registration
