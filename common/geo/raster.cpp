#include "common/geo/raster.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <mutex>
#include <stdexcept>
#include <vector>

#include <fmt/format.h>
#include <gdal_priv.h>
#include <ogr_spatialref.h>
#include <opencv2/imgproc.hpp>

namespace orthonav {

namespace {

constexpr GIntBig kCacheBytes = 256 << 20;  // of raster blocks, for all rasters of the process
constexpr GIntBig kLargestBlock = 1 << 30;  // bytes of all bands: one is read as a whole, whatever the cache may hold

void register_drivers() {
  static std::once_flag once;
  std::call_once(once, [] {
    GDALAllRegister();
    // GDAL's own limit grows with the machine: a twentieth of its memory.
    GDALSetCacheMax64(kCacheBytes);
    CPLSetErrorHandler(CPLQuietErrorHandler);  // errors are reported through exceptions, with the file's name
  });
}

[[noreturn]] void fail(const std::filesystem::path& file, const std::string& what) {
  const std::string detail = CPLGetLastErrorMsg();
  throw std::runtime_error(fmt::format("{}: {}{}{}", file.string(), what, detail.empty() ? "" : ": ", detail));
}

struct DatasetCloser {
  void operator()(GDALDataset* dataset) const { GDALClose(dataset); }
};
using Dataset = std::unique_ptr<GDALDataset, DatasetCloser>;

std::unique_ptr<OGRSpatialReference> wgs84() {
  auto crs = std::make_unique<OGRSpatialReference>();
  crs->SetWellKnownGeogCS("WGS84");
  crs->SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  return crs;
}

}  // namespace

struct Raster::Impl {
  std::filesystem::path file;
  Dataset dataset;
  double transform[6] = {};
  double inverse[6] = {};
  std::unique_ptr<OGRCoordinateTransformation> to_wgs84;
  std::unique_ptr<OGRCoordinateTransformation> from_wgs84;

  Eigen::Vector2d pixel_to_crs(const Eigen::Vector2d& pixel) const {
    Eigen::Vector2d xy;
    GDALApplyGeoTransform(const_cast<double*>(transform), pixel.x() + 0.5, pixel.y() + 0.5, &xy.x(), &xy.y());
    return xy;
  }

  cv::Rect clip(const cv::Rect& window) const {
    return window & cv::Rect(0, 0, dataset->GetRasterXSize(), dataset->GetRasterYSize());
  }

  // Values of band 1, `size` of them spread over the window; NaN where there is no data.
  cv::Mat sample(const cv::Rect& window, const cv::Size& size) const {
    cv::Mat values(size, CV_32F);
    cv::Mat mask(size, CV_8U);
    GDALRasterBand* band = dataset->GetRasterBand(1);
    if (band->RasterIO(GF_Read, window.x, window.y, window.width, window.height, values.data, size.width, size.height,
                       GDT_Float32, 0, 0) != CE_None ||
        band->GetMaskBand()->RasterIO(GF_Read, window.x, window.y, window.width, window.height, mask.data, size.width,
                                      size.height, GDT_Byte, 0, 0) != CE_None) {
      fail(file, fmt::format("cannot read {}x{} at {}+{}: is the file truncated?", window.width, window.height,
                             window.x, window.y));
    }
    values.setTo(std::numeric_limits<float>::quiet_NaN(), mask == 0);
    return values;
  }

  // From the raster's values to 8 bits: grey = scale (value - low). Found once, where values are not 8-bit.
  bool range_known = false;
  double low = 0;
  double scale = 1;

  bool is_colour() const {
    return dataset->GetRasterCount() >= 3 && dataset->GetRasterBand(1)->GetColorInterpretation() != GCI_GrayIndex;
  }

  void find_range() {
    range_known = true;
    constexpr int kSamples = 1000;
    const cv::Rect all(0, 0, dataset->GetRasterXSize(), dataset->GetRasterYSize());
    const cv::Mat values = sample(all, {std::min(all.width, kSamples), std::min(all.height, kSamples)});
    std::vector<float> known;
    std::copy_if(values.begin<float>(), values.end<float>(), std::back_inserter(known),
                 [](float value) { return std::isfinite(value); });
    if (known.empty()) return;  // no data: nothing to stretch
    std::sort(known.begin(), known.end());
    low = known[known.size() / 200];
    const double high = known[known.size() - 1 - known.size() / 200];
    scale = high > low ? 255.0 / (high - low) : 1.0;
  }

  // Grey value of each palette entry; empty without a palette.
  cv::Mat palette() const {
    const GDALColorTable* table = dataset->GetRasterBand(1)->GetColorTable();
    if (table == nullptr || dataset->GetRasterBand(1)->GetColorInterpretation() != GCI_PaletteIndex) return {};
    cv::Mat grey = cv::Mat::zeros(1, 256, CV_8U);
    for (int i = 0; i < std::min(256, table->GetColorEntryCount()); ++i) {
      const GDALColorEntry* entry = table->GetColorEntry(i);
      grey.at<uchar>(i) = cv::saturate_cast<uchar>(0.299 * entry->c1 + 0.587 * entry->c2 + 0.114 * entry->c3);
    }
    return grey;
  }

  // Reads bands 1 to image.channels() of `inside` into the window-sized `image` at its place.
  void read(const cv::Rect& window, const cv::Rect& inside, cv::Mat& image, GDALDataType type) const {
    cv::Mat target = image(cv::Rect(inside.x - window.x, inside.y - window.y, inside.width, inside.height));
    if (dataset->RasterIO(GF_Read, inside.x, inside.y, inside.width, inside.height, target.data, inside.width,
                          inside.height, type, image.channels(), nullptr, static_cast<GSpacing>(image.elemSize()),
                          static_cast<GSpacing>(image.step), static_cast<GSpacing>(image.elemSize1()),
                          nullptr) != CE_None) {
      fail(file, fmt::format("cannot read {}x{} at {}+{}: is the file truncated?", inside.width, inside.height,
                             inside.x, inside.y));
    }
  }

  void read_mask(const cv::Rect& window, const cv::Rect& inside, cv::Mat& mask) const {
    cv::Mat target = mask(cv::Rect(inside.x - window.x, inside.y - window.y, inside.width, inside.height));
    if (dataset->GetRasterBand(1)->GetMaskBand()->RasterIO(GF_Read, inside.x, inside.y, inside.width, inside.height,
                                                           target.data, inside.width, inside.height, GDT_Byte, 1,
                                                           static_cast<GSpacing>(mask.step)) != CE_None) {
      fail(file, "cannot read the mask: is the file truncated?");
    }
  }
};

namespace {

void check_blocks(const std::filesystem::path& file, GDALDataset& dataset) {
  const auto check = [&](GDALRasterBand& band) {
    int width = 0, height = 0;
    band.GetBlockSize(&width, &height);
    const GIntBig bytes =
        GIntBig{width} * height * GDALGetDataTypeSizeBytes(band.GetRasterDataType()) * dataset.GetRasterCount();
    if (bytes <= kLargestBlock) return;
    fail(file, fmt::format("is stored in blocks of {}x{} pixels, which take {} MB each: write it anew in tiles "
                           "(gdal_translate -co TILED=YES)",
                           width, height, bytes >> 20));
  };
  for (int index = 1; index <= dataset.GetRasterCount(); ++index) {
    GDALRasterBand* band = dataset.GetRasterBand(index);
    check(*band);
    for (int level = 0; level < band->GetOverviewCount(); ++level) {
      if (GDALRasterBand* overview = band->GetOverview(level)) check(*overview);
    }
  }
}

}  // namespace

Raster::Raster(const std::filesystem::path& file) : impl_(std::make_unique<Impl>()) {
  register_drivers();
  impl_->file = file;
  CPLErrorReset();
  impl_->dataset.reset(GDALDataset::Open(file.c_str(), GDAL_OF_RASTER | GDAL_OF_READONLY));
  if (!impl_->dataset) fail(file, "cannot open as a raster");
  if (impl_->dataset->GetRasterCount() < 1) fail(file, "has no band");
  check_blocks(file, *impl_->dataset);
  if (impl_->dataset->GetGeoTransform(impl_->transform) != CE_None) fail(file, "has no georeference (geotransform)");
  if (GDALInvGeoTransform(impl_->transform, impl_->inverse) == 0)
    fail(file, "has a georeference that cannot be inverted");
  const OGRSpatialReference* crs = impl_->dataset->GetSpatialRef();
  if (crs == nullptr) fail(file, "has no coordinate reference system");
  OGRSpatialReference source(*crs);
  source.SetAxisMappingStrategy(OAMS_TRADITIONAL_GIS_ORDER);
  const auto geographic = wgs84();
  impl_->to_wgs84.reset(OGRCreateCoordinateTransformation(&source, geographic.get()));
  impl_->from_wgs84.reset(OGRCreateCoordinateTransformation(geographic.get(), &source));
  if (!impl_->to_wgs84 || !impl_->from_wgs84) fail(file, "has a coordinate system that cannot be brought to WGS84");
}

Raster::~Raster() = default;
Raster::Raster(Raster&&) noexcept = default;
Raster& Raster::operator=(Raster&&) noexcept = default;

const std::filesystem::path& Raster::file() const {
  return impl_->file;
}
int Raster::width() const {
  return impl_->dataset->GetRasterXSize();
}
int Raster::height() const {
  return impl_->dataset->GetRasterYSize();
}

Geodetic Raster::pixel_to_geodetic(const Eigen::Vector2d& pixel) const {
  Eigen::Vector2d xy = impl_->pixel_to_crs(pixel);
  if (impl_->to_wgs84->Transform(1, &xy.x(), &xy.y()) == 0) {
    fail(impl_->file, fmt::format("pixel {:.1f}, {:.1f} cannot be brought to WGS84", pixel.x(), pixel.y()));
  }
  return {xy.y(), xy.x(), 0.0};
}

Eigen::Vector2d Raster::geodetic_to_pixel(const Geodetic& position) const {
  Eigen::Vector2d xy(position.longitude_deg, position.latitude_deg);
  if (impl_->from_wgs84->Transform(1, &xy.x(), &xy.y()) == 0) {
    fail(impl_->file, fmt::format("{:.6f}, {:.6f} lies outside the raster's coordinate system", position.latitude_deg,
                                  position.longitude_deg));
  }
  Eigen::Vector2d pixel;
  GDALApplyGeoTransform(impl_->inverse, xy.x(), xy.y(), &pixel.x(), &pixel.y());
  return pixel - Eigen::Vector2d(0.5, 0.5);
}

double Raster::metres_per_pixel(const Eigen::Vector2d& pixel) const {
  const EnuFrame frame(pixel_to_geodetic(pixel));
  // A step of several pixels keeps the difference clear of rounding in degrees.
  constexpr double kStep = 10.0;
  const Eigen::Vector3d right = frame.to_enu(pixel_to_geodetic(pixel + Eigen::Vector2d(kStep, 0)));
  const Eigen::Vector3d down = frame.to_enu(pixel_to_geodetic(pixel + Eigen::Vector2d(0, kStep)));
  return std::sqrt(right.head<2>().norm() * down.head<2>().norm()) / kStep;
}

cv::Mat Raster::read_grey(const cv::Rect& window, cv::Mat* valid) const {
  const cv::Rect inside = impl_->clip(window);
  cv::Mat grey(window.size(), CV_8U, cv::Scalar(0));
  if (valid != nullptr) *valid = cv::Mat(window.size(), CV_8U, cv::Scalar(0));
  if (inside.empty()) return grey;

  const bool bytes = impl_->dataset->GetRasterBand(1)->GetRasterDataType() == GDT_Byte;
  if (!bytes && !impl_->range_known) impl_->find_range();
  const int channels = impl_->is_colour() ? 3 : 1;
  cv::Mat bands(window.size(), CV_MAKETYPE(bytes ? CV_8U : CV_32F, channels), cv::Scalar::all(0));
  impl_->read(window, inside, bands, bytes ? GDT_Byte : GDT_Float32);
  if (!bytes) {
    cv::patchNaNs(bands, impl_->low);
    bands.convertTo(bands, CV_8U, impl_->scale, -impl_->scale * impl_->low);
  }
  if (channels == 3) {
    cv::cvtColor(bands, grey, cv::COLOR_RGB2GRAY);
  } else {
    grey = bands;
    if (const cv::Mat palette = impl_->palette(); !palette.empty()) cv::LUT(grey, palette, grey);
  }
  if (valid != nullptr) impl_->read_mask(window, inside, *valid);
  return grey;
}

cv::Mat Raster::read_float(const cv::Rect& window) const {
  cv::Mat values(window.size(), CV_32F, cv::Scalar(std::numeric_limits<float>::quiet_NaN()));
  const cv::Rect inside = impl_->clip(window);
  if (!inside.empty()) sample_float(inside, inside.size()).copyTo(values(inside - window.tl()));
  return values;
}

cv::Mat Raster::sample_float(const cv::Rect& window, const cv::Size& size) const {
  return impl_->sample(window, size);
}

std::vector<std::filesystem::path> raster_files(const std::filesystem::path& file) {
  register_drivers();
  std::vector<std::filesystem::path> files;
  std::vector<std::filesystem::path> open{file};
  while (!open.empty()) {
    const std::filesystem::path next = open.back();
    open.pop_back();
    if (std::find(files.begin(), files.end(), next) != files.end()) continue;
    files.push_back(next);
    CPLErrorReset();
    const Dataset dataset(GDALDataset::Open(next.c_str(), GDAL_OF_RASTER | GDAL_OF_READONLY));
    if (!dataset) {
      if (next == file) fail(file, "cannot open as a raster");
      continue;  // a world file or the like
    }
    const CPLStringList list(dataset->GetFileList());
    for (int i = 0; i < list.size(); ++i) open.emplace_back(list[i]);
  }
  std::sort(files.begin() + 1, files.end());
  return files;
}

void write_geotiff(const std::filesystem::path& file, const cv::Mat& image, const RasterGrid& grid, int jpeg_quality) {
  register_drivers();
  CPLErrorReset();
  const bool is_float = image.depth() == CV_32F;
  if ((!is_float && image.depth() != CV_8U) || (image.channels() != 1 && image.channels() != 3) || image.empty()) {
    throw std::runtime_error(file.string() + ": a GeoTIFF is written from 8-bit or float images of 1 or 3 channels");
  }
  GDALDriver* driver = GetGDALDriverManager()->GetDriverByName("GTiff");
  if (driver == nullptr) fail(file, "GDAL has no GeoTIFF driver");
  std::vector<std::string> options{"TILED=YES"};
  if (jpeg_quality > 0 && !is_float) {
    options.insert(options.end(), {"COMPRESS=JPEG", fmt::format("JPEG_QUALITY={}", jpeg_quality)});
    if (image.channels() == 3) options.emplace_back("PHOTOMETRIC=YCBCR");
  } else {
    options.insert(options.end(), {"COMPRESS=DEFLATE", is_float ? "PREDICTOR=3" : "PREDICTOR=2"});
  }
  CPLStringList list;
  for (const auto& option : options) list.AddString(option.c_str());

  Dataset dataset(driver->Create(file.c_str(), image.cols, image.rows, image.channels(),
                                 is_float ? GDT_Float32 : GDT_Byte, list.List()));
  if (!dataset) fail(file, "cannot create");
  double transform[6];
  std::copy(std::begin(grid.transform), std::end(grid.transform), transform);
  OGRSpatialReference crs;
  if (crs.SetFromUserInput(grid.crs.c_str()) != OGRERR_NONE) fail(file, "unknown coordinate system " + grid.crs);
  if (dataset->SetGeoTransform(transform) != CE_None || dataset->SetSpatialRef(&crs) != CE_None) {
    fail(file, "cannot write the georeference");
  }
  cv::Mat picture = image;
  if (image.channels() == 3) cv::cvtColor(image, picture, cv::COLOR_BGR2RGB);
  const auto element = static_cast<GSpacing>(picture.elemSize1());
  if (dataset->RasterIO(GF_Write, 0, 0, picture.cols, picture.rows, picture.data, picture.cols, picture.rows,
                        is_float ? GDT_Float32 : GDT_Byte, picture.channels(), nullptr,
                        static_cast<GSpacing>(picture.elemSize()), static_cast<GSpacing>(picture.step), element,
                        nullptr) != CE_None) {
    fail(file, "cannot write: is the disk full?");
  }
  dataset->FlushCache();
}

}  // namespace orthonav
