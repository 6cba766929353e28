// Histograms from Python, of any type that they come in.
#pragma once
#include "python/bindings.h"
#include "reconstruct/count_rows.h"

namespace mars {

using Histograms = nb::ndarray<nb::ndim<2>, nb::c_contig, nb::device::cpu, nb::ro>;  // (pixels, bins)

inline CountRows rows_of(const Histograms& histograms) {
    using Type = CountRows::Type;
    const nb::dlpack::dtype type = histograms.dtype();
    if (type != nb::dtype<uint16_t>() && type != nb::dtype<uint32_t>() && type != nb::dtype<double>())
        throw nb::type_error("histograms must be of uint16, uint32 or float64");
    return {histograms.data(),
            type == nb::dtype<uint16_t>()   ? Type::kUint16
            : type == nb::dtype<uint32_t>() ? Type::kUint32
                                            : Type::kDouble,
            static_cast<int64_t>(histograms.shape(1))};
}

}  // namespace mars
