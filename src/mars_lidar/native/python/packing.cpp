// Bindings of packed counts; storage/packing.h has the format.
#include "storage/packing.h"

#include <nanobind/stl/vector.h>

#include "python/bindings.h"

namespace mars {
namespace {

template <class Count>
nb::bytes pack(Vector<const Count> counts) {
    const size_t size = counts.shape(0);
    if (size > UINT32_MAX) throw nb::value_error("a chunk must have fewer than 2**32 counts");
    static thread_local std::vector<uint8_t> out;  // kept: fresh pages would cost as much as the packing
    size_t used = 0;
    {
        const nb::gil_scoped_release release;
        used = pack_counts(counts.data(), size, out);
    }
    return nb::bytes(out.data(), used);
}

template <class Count>
void unpack_one(Vector<const uint8_t> packed, Count* out, size_t size) {
    const Packed source(packed.data(), packed.shape(0));
    if (source.size != size) throw std::invalid_argument("packed counts are of another size than their chunk");
    unpack_counts(source, out);
}

template <class Count>
void unpack(Vector<const uint8_t> packed, Vector<Count> out) {
    const nb::gil_scoped_release release;
    unpack_one(packed, out.data(), out.shape(0));
}

// Row k of `out` becomes what packed[k] holds.
template <class Count>
void unpack_batch(const std::vector<Vector<const uint8_t>>& packed, Matrix<Count> out) {
    const nb::gil_scoped_release release;
    if (packed.size() != out.shape(0)) throw std::invalid_argument("out must have a row for each packed chunk");
    const size_t size = out.shape(1);
    for (size_t k = 0; k < packed.size(); ++k) unpack_one(packed[k], out.data() + k * size, size);
}

}  // namespace

void bind_packing(nb::module_& module) {
    module.def("pack_counts", &pack<uint16_t>, "counts"_a.noconvert(), "Packed counts (n,).");
    module.def("pack_counts", &pack<uint32_t>, "counts"_a.noconvert());
    module.def("unpack_counts", &unpack<uint16_t>, "packed"_a, "out"_a.noconvert(),
               "Fill `out` (n,) with what `pack_counts` packed.");
    module.def("unpack_counts", &unpack<uint32_t>, "packed"_a, "out"_a.noconvert());
    module.def(
        "unpack_batch", &unpack_batch<uint16_t>, "packed"_a, "out"_a.noconvert(),
        "Fill row k of `out` (n, size) with what packed[k] holds; a ValueError where an integer type is too small.");
    module.def("unpack_batch", &unpack_batch<uint32_t>, "packed"_a, "out"_a.noconvert());
    module.def("unpack_batch", &unpack_batch<int16_t>, "packed"_a, "out"_a.noconvert());
    module.def("unpack_batch", &unpack_batch<int32_t>, "packed"_a, "out"_a.noconvert());
    module.def("unpack_batch", &unpack_batch<float>, "packed"_a, "out"_a.noconvert());
}

}  // namespace mars
