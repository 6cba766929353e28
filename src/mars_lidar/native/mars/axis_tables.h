// The axes of a table, with the logarithms, scales and cells by which mars/table_lookup.h finds a pixel's place in them.
#pragma once
#include <algorithm>
#include <vector>

#include "mars/table_lookup.h"

namespace mars {

// An axis and the tables that go with it.
class AxisTables {
 public:
    AxisTables(const double* values, int64_t size) {
        Axis& axis = axis_;
        axis.value = values;
        axis.size = size;
        axis.lowest = axis.size > 1 && axis.value[0] <= 0.0;
        for (int64_t k = 0; k < axis.size; ++k) log_.push_back(TableFlux(axis.value[k]).log);
        axis.count = static_cast<int32_t>(std::min<int64_t>(4, axis.size - axis.lowest));
        scale_.resize(static_cast<size_t>(4 * axis.size));
        for (int64_t first = axis.lowest; first + axis.count <= axis.size; ++first)
            lagrange_scales(log_.data() + first, axis.count, scale_.data() + 4 * first);
        const double range = axis.size > 0 ? log_.back() - log_[static_cast<size_t>(axis.lowest)] : 0.0;
        if (range > 0.0) set_cells(range);
        axis.log = log_.data();
        axis.scale = scale_.data();
        axis.start = start_.data();
        axis.starts = static_cast<int64_t>(start_.size());
    }
    AxisTables(const AxisTables&) = delete;
    AxisTables& operator=(const AxisTables&) = delete;

    const Axis& axis() const { return axis_; }
    const std::vector<double>& log() const { return log_; }
    const std::vector<double>& scale() const { return scale_; }
    const std::vector<int64_t>& start() const { return start_; }

 private:
    // Twice as many cells of equal width in the logarithm as nodes: a lookup then steps over one node or none.
    void set_cells(double range) {
        const int64_t cells = 2 * axis_.size;
        axis_.cells_per_log = static_cast<double>(cells) / range;
        int64_t at = axis_.lowest;
        for (int64_t c = 0; c <= cells; ++c) {
            while (at + 1 < axis_.size &&
                   (log_[at + 1] - log_[axis_.lowest]) * axis_.cells_per_log <= static_cast<double>(c))
                ++at;
            start_.push_back(at);
        }
    }

    Axis axis_{};
    std::vector<double> log_, scale_;
    std::vector<int64_t> start_;
};

}  // namespace mars
