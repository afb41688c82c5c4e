// A GeoTIFF behind the raster wrapper: every call on whatever GDAL opens.
#include <stdexcept>

#include <gdal_priv.h>

#include "common/geo/raster.h"
#include "tests/fuzz/scratch_file.h"

extern "C" int LLVMFuzzerInitialize(int*, char***) {
  CPLSetErrorHandler(CPLQuietErrorHandler);
  return 0;
}

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  try {
    const orthonav::Raster raster(orthonav::fuzz::scratch_file("map.tif", data, size));
    const Eigen::Vector2d middle(raster.width() / 2.0, raster.height() / 2.0);
    raster.geodetic_to_pixel(raster.pixel_to_geodetic(middle));
    raster.metres_per_pixel(middle);
    cv::Mat valid;
    raster.read_grey({-5, -5, 40, 40}, &valid);
    raster.read_float({0, 0, 16, 16});
  } catch (const std::runtime_error&) {
    // The only thing that a file may do.
  }
  return 0;
}
