// Bindings of the count law with four given cumulants; engines use matched_law.h itself.
#include "laws/matched_law.h"
#include "laws/matched_trust.h"
#include "python/bindings.h"
#include "python/watched.h"

namespace mars {
namespace {

constexpr int64_t kChunkCells = 256;

Cumulants cumulants_of(const Matrix<const double>& all, int64_t cell) {
    const double* k = all.data() + 4 * cell;
    return {k[0], k[1], k[2], k[3]};
}

int64_t check_cells(const Matrix<const double>& cumulants) {
    if (cumulants.shape(1) != 4) throw nb::value_error("cumulants must be of shape (cells, 4)");
    return static_cast<int64_t>(cumulants.shape(0));
}

// Calls work(cell) for each cell, on threads.
template <class Work>
void for_cells(int64_t cells, int threads, const Work& work) {
    run_watched_items(cells, kChunkCells, threads, nb::none(), [&] { return work; });
}

void support(Matrix<const double> cumulants, Vector<int64_t> first, Vector<int64_t> last, Vector<bool> trusted,
             int threads) {
    const int64_t cells = check_cells(cumulants);
    expect("first, last and trusted must be of shape (cells)", {cells}, first, last, trusted);
    for_cells(cells, threads, [&](int64_t cell) {
        const Cumulants given = cumulants_of(cumulants, cell);
        const MatchedLaw law(given);
        first.data()[cell] = law.first();
        last.data()[cell] = law.last();
        trusted.data()[cell] = mars::trusted(given, law);
    });
}

void probabilities(Matrix<const double> cumulants, Vector<const int64_t> first, Vector<const int64_t> start,
                   Vector<double> out, int threads) {
    const int64_t cells = check_cells(cumulants);
    if (static_cast<int64_t>(first.shape(0)) != cells || static_cast<int64_t>(start.shape(0)) != cells + 1 ||
        static_cast<int64_t>(out.shape(0)) < start.data()[cells])
        throw nb::value_error("first must be of shape (cells), start of (cells + 1), out must hold all");
    for_cells(cells, threads, [&](int64_t cell) {
        const MatchedLaw law(cumulants_of(cumulants, cell));
        const int64_t begin = start.data()[cell], size = start.data()[cell + 1] - begin;
        double below, above, below_next, above_next;
        law.tails(first.data()[cell] - 1, below, above);
        for (int64_t i = 0; i < size; ++i) {
            law.tails(first.data()[cell] + i, below_next, above_next);
            // differences of the smaller tail keep their digits
            const double p = above < 0.5 ? above - above_next : below_next - below;
            out.data()[begin + i] = std::max(p, 0.0);
            below = below_next;
            above = above_next;
        }
    });
}

void draw(Matrix<const double> cumulants, Matrix<const double> uniform, Matrix<int64_t> out, int threads) {
    const int64_t cells = check_cells(cumulants), number = static_cast<int64_t>(uniform.shape(1));
    expect("uniform and out must be of shape (cells, draws)", {cells, number}, uniform, out);
    for_cells(cells, threads, [&](int64_t cell) {
        const MatchedLaw law(cumulants_of(cumulants, cell));
        for (int64_t i = cell * number; i < (cell + 1) * number; ++i) out.data()[i] = law.draw(uniform.data()[i]);
    });
}

}  // namespace

void bind_matched(nb::module_& module) {
    module.def("matched_support", &support, "cumulants"_a, "first"_a.noconvert(), "last"_a.noconvert(),
               "trusted"_a.noconvert(), "threads"_a,
               "First and last count (cells) of the laws with these cumulants (cells, 4); whether they are close.");
    module.def("matched_pmf", &probabilities, "cumulants"_a, "first"_a, "start"_a, "out"_a.noconvert(), "threads"_a,
               "Probabilities of the counts first, first + 1, ... of each cell, out[start[cell]:start[cell + 1]].");
    module.def("matched_draw", &draw, "cumulants"_a, "uniform"_a, "out"_a.noconvert(), "threads"_a,
               "Counts out (cells, draws) at the uniform numbers (cells, draws).");
}

}  // namespace mars
