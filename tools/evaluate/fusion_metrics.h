// The figures of the fusion: accuracy, consistency, integrity, continuity.
#pragma once

#include "tools/evaluate/metrics.h"

namespace orthonav::evaluate {

FusionMetrics evaluate_fusion(const FlightRecord& record);

}  // namespace orthonav::evaluate
