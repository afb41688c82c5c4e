// The names of the bus's channels, in one place.
#pragma once

namespace orthonav::channel {

inline constexpr const char* kImu = "IMU";                           // imu_t
inline constexpr const char* kCamera = "CAMERA";                     // image_t
inline constexpr const char* kCompass = "COMPASS";                   // compass_t
inline constexpr const char* kMagnetometer = "MAGNETOMETER";         // magnetometer_t, raw
inline constexpr const char* kAltitude = "ALTITUDE";                 // altitude_t
inline constexpr const char* kGnssReference = "GNSS_REFERENCE";      // gnss_reference_t, evaluation only
inline constexpr const char* kTruth = "TRUTH";                       // truth_t, evaluation only
inline constexpr const char* kVioState = "VIO_STATE";                // vio_state_t
inline constexpr const char* kVioKeyframe = "VIO_KEYFRAME";          // vio_keyframe_t
inline constexpr const char* kKeyframeImage = "KEYFRAME_IMAGE";      // keyframe_image_t
inline constexpr const char* kVioReset = "VIO_RESET";                // vio_reset_t
inline constexpr const char* kMapInfo = "MAP_INFO";                  // map_info_t
inline constexpr const char* kMapTileRequest = "MAP_TILE_REQUEST";   // map_tile_request_t
inline constexpr const char* kMapTile = "MAP_TILE";                  // map_tile_t
inline constexpr const char* kMapFix = "MAP_FIX";                    // map_fix_t
inline constexpr const char* kPlaceHypotheses = "PLACE_HYPOTHESES";  // place_hypotheses_t
inline constexpr const char* kPositionHint = "POSITION_HINT";        // position_hint_t
inline constexpr const char* kNavState = "NAV_STATE";                // nav_state_t
inline constexpr const char* kHealth = "HEALTH";                     // health_t

}  // namespace orthonav::channel
