// Bindings of the lookup in a table, for many pixels on threads; mars/table_lookup.h is the lookup.
#include <algorithm>

#include "mars/axis_tables.h"
#include "python/bindings.h"
#include "python/watched.h"

namespace mars {

namespace {

constexpr int64_t kBlock = 512;  // pixels per chunk

void lookup(Vector<const double> signal_axis, Vector<const double> background_axis, Matrix<const double> entries,
            Vector<const double> limit, Vector<const double> sub_signal, Vector<const double> sub_background,
            Vector<const double> phase, Matrix<const float> correction, Vector<const double> signal,
            Vector<const double> background, Vector<const double> at, bool nearest, Matrix<int64_t> rows,
            Matrix<double> weights, Matrix<double> cumulants, int threads) {
    const auto tables = [](const Vector<const double>& axis) { return AxisTables(axis.data(), size_of(axis)); };
    const AxisTables s = tables(signal_axis), b = tables(background_axis);
    const AxisTables x = tables(sub_signal), y = tables(sub_background);
    const TableLookup table{s.axis(),
                            b.axis(),
                            x.axis(),
                            y.axis(),
                            entries.data(),
                            limit.data(),
                            phase.data(),
                            static_cast<int64_t>(phase.shape(0)),
                            correction.data(),
                            nearest ? 1 : 0,
                            0};
    const int64_t pixels = static_cast<int64_t>(signal.shape(0));
    const size_t sub = sub_signal.shape(0) * sub_background.shape(0);
    if (table.signal.size < 1 || table.background.size < 1 || entries.shape(1) != kCumulants ||
        entries.shape(0) != signal_axis.shape(0) * background_axis.shape(0))
        throw nb::value_error("entries must be (signal * background, 4)");
    expect("limit must be (4)", {kCumulants}, limit);
    if (table.phases == 1 || (table.phases > 1 && (sub == 0 || correction.shape(0) != sub ||
                                                   correction.shape(1) != phase.shape(0) * kCumulants)))
        throw nb::value_error("correction must be (sub_signal * sub_background, phases * 4)");
    expect("signal, background and at must agree", {pixels}, background, at);
    expect("rows, weights and cumulants must be (pixels, 4)", {pixels, kCumulants}, rows, weights, cumulants);
    run_watched_items(pixels, kBlock, threads, nb::none(), [&] {
        return [&](int64_t p) {
            table.pixel(signal.data()[p], background.data()[p], at.data()[p], rows.data() + 4 * p,
                        weights.data() + 4 * p, cumulants.data() + kCumulants * p);
        };
    });
}

}  // namespace

void bind_table(nb::module_& module) {
    module.def("table_lookup", &lookup, nb::kw_only(), "signal_axis"_a, "background_axis"_a, "entries"_a, "limit"_a,
               "sub_signal"_a, "sub_background"_a, "phase"_a, "correction"_a, "signal"_a, "background"_a, "at"_a,
               "nearest"_a, "rows"_a, "weights"_a, "cumulants"_a, "threads"_a);
}

}  // namespace mars
