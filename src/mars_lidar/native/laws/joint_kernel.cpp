// Gauss-Seidel sweeps of the transposed feedback equation (docs/joint_law.md) at one vector level; lanes are
// windows.
#include "laws/joint_kernel.h"

#include <vector>

#include "laws/joint_period.h"

namespace mars {

void MARS_JOIN(joint_adjoint_, MARS_LEVEL)(const AdjointBlock& block) {
    const int32_t n = block.bins;
    const FeedbackGrid grid{block.response, 0, n, block.shift, block.fraction};
    std::vector<Real> mass_in(n), moment_in(n), mass(n), moment(n);
    std::vector<Worth<Real>> worth(n);
    for (int k = 0; k < block.count; ++k) {
        const int64_t row = (block.first + k) * n;
        for (int32_t j = 0; j < n; ++j) {
            set_lane(mass_in[j], k, block.mass_in[row + j]);
            if (block.moment_in) set_lane(moment_in[j], k, block.moment_in[row + j]);
        }
    }
    const bool self = grid.shift == 0;
    Real window{};
    std::vector<Convergence> left(kReals, Convergence(n));
    int64_t sweeps = 0;
    double error[kReals];
    for (double& e : error) e = INFINITY;
    bool all = false;
    while (sweeps < block.sweeps && !all && !block.stop->load(std::memory_order_relaxed)) {
        auto sweep = self ? period_backward<true, false, Real> : period_backward<false, false, Real>;
        const Real change = sweep(grid, mass_in.data(), moment_in.data(), worth.data(), worth.data(), worth.data(),
                                  window, mass.data(), moment.data());
        ++sweeps;
        Real size{};
        for (int32_t j = 0; j < n; ++j) size = larger(size, absolute(mass[j]));
        all = true;
        for (int k = 0; k < block.count; ++k) {
            error[k] = left[k](lane(change, k), lane(size, k));
            all = all && error[k] <= block.tolerance;
        }
    }
    for (int k = 0; k < block.count; ++k) {
        const int64_t row = (block.first + k) * n;
        for (int32_t j = 0; j < n; ++j) {
            block.mass[row + j] = lane(mass[j], k);
            block.moment[row + j] = lane(moment[j], k);
        }
        block.done[block.first + k] = sweeps;
        block.error[block.first + k] = error[k];
    }
}

}  // namespace mars
