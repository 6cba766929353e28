// The counts of histograms, one row a pixel, of any type that they come in.
#pragma once
#include <cstdint>

namespace mars {

struct CountRows {
    enum class Type { kUint16, kUint32, kDouble };

    const void* counts;  // (pixels, bins)
    Type type;
    int64_t bins;

    // The counts (bins) of a pixel.
    void copy(int64_t pixel, double* to) const {
        switch (type) {
            case Type::kUint16:
                return copy_from(static_cast<const uint16_t*>(counts) + pixel * bins, to);
            case Type::kUint32:
                return copy_from(static_cast<const uint32_t*>(counts) + pixel * bins, to);
            case Type::kDouble:
                return copy_from(static_cast<const double*>(counts) + pixel * bins, to);
        }
    }

 private:
    template <class Count>
    void copy_from(const Count* row, double* to) const {
        for (int64_t j = 0; j < bins; ++j) to[j] = static_cast<double>(row[j]);
    }
};

}  // namespace mars
