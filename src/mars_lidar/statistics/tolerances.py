"""Largest costs of the statistics of one pixel, accuracies, and sizes of grids and blocks.

Costs are counted, not timed, so that refusals do not depend on the machine. Seconds are those of one core at 3 GHz.
Every result is checked where it is computed, against a finer grid, a residual or known moments, so that a coarse first
guess costs time and not accuracy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Largest costs of one statistic of one pixel.

    Attributes
    ----------
    recursion, one_pass
        Bins x periods of the exposure recursion, on all grids together and on one of them; 80 ns each.
    transform
        Bins x periods x batches of eight points of the generating function of the count; 12 ns each.
    transient
        Bins x periods of the start-up transient, after which the closed form of the joint law holds; 12 ns each.
    joint_steps
        Bins x periods of an exposure that ends within its start-up transient, through which the joint law steps once
        for every window.
    record_kernel
        Probabilities from record to record behind electronics with a dead time; 8 bytes each.
    record_moments, record_points
        Multiplications for the moments of the number of these records, and for the points of its law.
    synchronous_terms, synchronous_points
        Terms of the sums for a count law of mode synchronous, and points x counts of its transform.
    history
        Bytes, in each thread, of the registrations of one dead time.
    """

    recursion: float
    one_pass: float
    transform: float = 8e7
    transient: int = 40_000_000
    joint_steps: int = 2**22
    record_kernel: int
    record_moments: float
    record_points: float = 2e10
    synchronous_terms: int = 2**23
    synchronous_points: int = 30_000_000
    history: int = 2**30

    def refusal(self, steps: float) -> str:
        """Why `steps` bins x periods of the exposure recursion are refused, in seconds of 80 ns a step."""
        return f"it would take about {8e-8 * steps:.2g} s, and the limit of a law is {8e-8 * self.recursion:.1g} s"


LAW = Budget(recursion=2.6e7, one_pass=2.6e7, record_kernel=2**24, record_moments=1.2e9)
"""Count laws, mean histograms and joint laws: about two seconds."""

MOMENTS = Budget(recursion=math.inf, one_pass=4e9, record_kernel=2**27, record_moments=4e10)
"""`exposure_moments` and `electronics_moments`: minutes, and a kernel of 1 GiB."""


def advice(*names: str) -> str:
    """End of a refusal: the alternatives, one of `names` or the exact engine."""
    simulate = "simulate it with engine 'exact'"
    return f"use {', '.join(names)}, or {simulate}" if names else simulate


@dataclass(frozen=True)
class Tolerances:
    """Constants of the statistics that are not arguments.

    Attributes
    ----------
    law_tolerance
        Default tolerance of the exact law of an exposure: `Exposure.movement`, the largest of the changes of mean (in
        standard deviations), further cumulants and shape (total variation) when the bins of a grid are last halved,
        (21) of docs/theory_exposure.md. The error is smaller.
    rounding
        Relative difference that is attributed to rounding: eps times some thousand terms of a sum.
    repeats
        Relative change of the state of a pixel per period at which it repeats, (20) of docs/theory_exposure.md.
    transient
        Total variation from the stationary state at which the start-up transient ends for the joint law.
    most_bins, most_even_bins
        Bins per period of any statistics grid (8 MiB an array), and of equal bins where others follow the pulse.
    first_bins, most_first_bins
        Bins per period of the coarsest and finest first grid; refinement may exceed the latter.
    compared_bins
        Fewest bins of the histogram in which grids are compared, at the cost of a single bin.
    two_halvings
        Movement over two halvings of the bins relative to that over the last, for errors of second order: 15/3.
    unrefined_bins
        Least bins of grids that are not refined, of the phase chain and without a dead time, and of the first grid that
        follows the pulse: with fewer the discretisation of the chain is visible in the variance of the count.
    chain_bins_per_width
        Bins of the phase chain in the width 1 / max s of the pulse, 2.507 sigma of a Gaussian: a bin is sigma / 3.
    pulse_samples
        Samples of the support of the pulse from which its width is computed.
    detected_bins, resolved_bins
        Grid bins per sigma of the pulse from which refinement of a grid detects the pulse, and from which finer bins
        change nothing.
    pulse_blocks, block_bins
        Fewest blocks of the period on a grid that follows the pulse (no block holds both ends of a wrapped pulse), and
        fewest bins of a block, half of them on the pulse.
    knots_per_sigma, longest_pulse
        Grid points per sigma of a pulse; support of a pulse, in sigma, up to which a grid that follows it resolves it.
    warm_periods, least_warm_periods, warm_steps
        Periods that an iteration towards the stationary state may take: at most, at least, and at most as periods x
        bins. Where it takes more, a sparse equation gives the state.
    chunk_bytes
        Energies and histograms computed together.
    near_bytes, middle_bytes
        Size of the history of one dead time up to which a step of the recursion takes 15 to 60 ns, and up to which it
        takes at most 100 ns; with a longer history it takes 100 to 350 ns.
    many_bins
        Bins of a histogram beyond which it is interpolated from a coarser grid, and of the largest grid of the joint
        law (a second or two) for histograms of fewer.
    cells_of_many, joint_cells_of_many
        Bins of the coarser grids, tried in turn: mean histogram, and joint law.
    few_windows_bins
        Bins of a grid of the joint law beyond which fewer windows are compared, because each takes long.
    block
        Cells, windows or bins of a matrix product computed together.
    sampled_delays
        Most cells of sampled afterpulse delays: 32 MiB an array.
    constant_light_rounds
        Most iterations for the mean rate under constant light.
    tail
        Bound on the probability outside the support of a count law, at either end.
    most_counts
        Most counts of a listed law: 128 MiB.
    lanes
        Points of the circle that the native core evaluates together.
    near_transform_bytes, far_transform_bytes, far_transform, period_bins
        Size of the history of these points above which a step costs `far_transform` times as much (as does any step
        where the dead time is below one bin), and above which it costs six times that; cost of the work that is done
        once a period, in bins.
    most_tilt, most_log_growth
        Largest exponential tilt per count, and logarithm of E e^(theta N) of one period: the largest double is e^709.
    consistent, consistent_per_cycle
        Allowed disagreement of a pmf with its cumulants, in standard deviations, and for rounding per extrapolated
        cycle.
    support_share, support_spreads
        Share of `Budget.transform` for bounds of the support; if it does not suffice, half of the width of the support
        in standard deviations, plus one count.
    guess_spreads, guess_counts, widest_guess
        Half width of a window guessed from mean and variance: standard deviations and further counts; most counts.
    edge, record_edge
        Largest probability at the ends of a window that contains a law, and a law of records.
    guess_mean
        Allowed difference of the mean of a law from the assumed one, in standard deviations.
    all_points
        Counts up to which a law is evaluated on all points of the circle.
    faint, record_faint
        Modulus below which the transform of a count law is taken as 0, and that of a law of records.
    short_variance, least_shorter
        Variance of the count of the shorter exposure whose transform is searched for further peaks, and least ratio of
        the exposures for which that is faster, (27) of docs/theory_exposure.md.
    blas_thread
        Multiplications of a matrix product up to which BLAS libraries use one thread.
    record_block
        Overhead of a block of records, in multiplications.
    records_repeat
        As `repeats`, behind electronics.
    records
        Least tolerance of statistics behind electronics with a dead time, the accuracy that is stated for them.
    direct_bins
        Bins up to which the equations for the stationary law of records are solved directly.
    record_iterations, record_change
        Most power iterations for larger ones; change of the last one in total variation, relative to 1 - contraction.
    record_mismatch
        Allowed disagreement of a pmf of records with mean and variance, in units of the tolerance.
    rate_steps, light_steps
        Cost of a bin in steps of the recursion: of the rates of a paralyzable pixel, at most; of the light of others.
    folded_factored
        Bins up to which a feedback equation of the joint law is factorised, in a second.
    folded_residual, folded_change, folded_sweeps, folded_checked
        Relative residual of this equation; change per sweep relative to the largest value; sweeps beyond which a
        factorisation is faster; windows of a block whose residual is checked.
    chain_sweeps
        Gauss-Seidel sweeps of the phase chain before its matrix is factorised.
    chain_passed
        Least probability of passing a bin in that matrix.
    chain_change, chain_residual, chain_worst_residual
        Relative change per sweep and backward error that end an iteration (rounding alone gives errors of 1e-16 to
        1e-14); largest backward error of a solution.
    holding_times
        Allowed difference of a moment of the holding times by independent routes, relative to its largest term.
    most_lags
        Most lags of a covariance, an O(n) product each.
    most_mean, matched_outside
        Largest mean of a matched law (doubles hold integers up to 9e15); probability outside its support, that of a
        normal law beyond 8 standard deviations.
    least_spread
        Smallest standard deviation of a count relative to Poisson: that of the most strongly locked pixels.
    synchronous_tail, synchronous_loose_tail
        Probability outside the support of a synchronous law, at either end, by its sums and by its transform.
    synchronous_late, synchronous_reach
        Half width, in standard deviations, of the sum over late registrations, and of the law and its transform.
    synchronous_terms, synchronous_terms_together, synchronous_sums, synchronous_counts, synchronous_points
        Terms of (6), and counts at the lower end, from which the transform (21) is used; terms computed together, of so
        many incomplete beta functions each; points of the circle evaluated together.
    parts_per_sigma, pieces_per_sigma, most_parts
        Parts of the period per sigma of jitter and light, at first (a part adds 1/6 of its square to the variance: 3e-4
        of sigma^2); pieces of parts per width of the narrowest light; and of either at most (512 KiB an array).
    timing_bytes
        Of the histograms on pieces that are computed together.
    """

    law_tolerance: float = 1e-4
    rounding: float = 1e-12
    repeats: float = 1e-12
    transient: float = 1e-9
    most_bins: int = 2**20
    most_even_bins: int = 2**15
    first_bins: int = 128
    most_first_bins: int = 2**14
    compared_bins: int = 32
    two_halvings: float = 5.0
    unrefined_bins: int = 512
    chain_bins_per_width: float = 7.5
    pulse_samples: int = 2**12
    detected_bins: float = 1 / 8
    resolved_bins: float = 2.0
    pulse_blocks: int = 4
    block_bins: int = 8
    knots_per_sigma: float = 8.0
    longest_pulse: float = 64.0
    warm_periods: int = 400
    least_warm_periods: int = 4
    warm_steps: int = 10_000_000
    chunk_bytes: int = 64 << 20
    near_bytes: int = 1 << 19
    middle_bytes: int = 1 << 25
    many_bins: int = 2**17
    cells_of_many: tuple[int, ...] = (2**15, 2**17)
    joint_cells_of_many: tuple[int, ...] = (2**13, 2**15, 2**16)
    few_windows_bins: int = 2**16
    block: int = 64
    sampled_delays: int = 2**22
    constant_light_rounds: int = 500
    tail: float = 1e-12
    most_counts: int = 2**24
    lanes: int = 8
    near_transform_bytes: int = 1 << 20
    far_transform_bytes: int = 1 << 26
    far_transform: float = 4.0
    period_bins: float = 128.0
    most_tilt: float = 25.0
    most_log_growth: float = 600.0
    consistent: float = 1e-5
    consistent_per_cycle: float = 1e-13
    support_share: float = 0.25
    support_spreads: float = 12.0
    guess_spreads: float = 7.5
    guess_counts: float = 6.0
    widest_guess: int = 1024
    edge: float = 1e-10
    record_edge: float = 1e-9
    guess_mean: float = 0.02
    all_points: int = 256
    faint: float = 1e-15
    record_faint: float = 1e-17
    short_variance: float = 4.0
    least_shorter: int = 6
    blas_thread: int = 250_000
    record_block: float = 2e4
    records_repeat: float = 1e-11
    records: float = 1e-3
    direct_bins: int = 2048
    record_iterations: int = 2000
    record_change: float = 1e-9
    record_mismatch: float = 3.0
    rate_steps: float = 120.0
    light_steps: float = 10.0
    folded_factored: int = 2**14
    folded_residual: float = 1e-9
    folded_change: float = 1e-10
    folded_sweeps: int = 200
    folded_checked: int = 3
    chain_sweeps: int = 24
    chain_passed: float = 1e-12
    chain_change: float = 1e-15
    chain_residual: float = 1e-12
    chain_worst_residual: float = 1e-10
    holding_times: float = 1e-7
    most_lags: int = 100_000
    most_mean: float = 1e15
    matched_outside: float = 1.5e-15
    least_spread: float = 1e-3
    synchronous_tail: float = 1e-13
    synchronous_loose_tail: float = 1e-10
    synchronous_late: float = 9.0
    synchronous_reach: float = 11.0
    synchronous_terms: int = 1 << 18
    synchronous_terms_together: int = 1 << 20
    synchronous_sums: int = 6
    synchronous_counts: int = 20
    synchronous_points: int = 32
    parts_per_sigma: float = 24.0
    pieces_per_sigma: float = 4.0
    timing_bytes: int = 32 << 20
    most_parts: int = 2**16


TOL = Tolerances()
