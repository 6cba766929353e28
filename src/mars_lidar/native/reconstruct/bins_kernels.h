// The kernels of bins at the widest level of this processor.
#pragma once
#include "lanes/kernels.h"
#include "reconstruct/bins_kernel.h"

namespace mars {

struct BinsKernels {
    void (*arm)(const ArmBlock&) = kernel_at<const ArmBlock&>("", MARS_KERNELS(arm_bins_));
    void (*energy)(const EnergyBlock&) = kernel_at<const EnergyBlock&>("", MARS_KERNELS(pulse_energy_));
    void (*passes)(const PassesBlock&) = kernel_at<const PassesBlock&>("", MARS_KERNELS(bin_passes_));
    BinSums (*terms)(const TermsBlock&) = kernel_at<const TermsBlock&, BinSums>("", MARS_KERNELS(bin_terms_));
    void (*products)(const ProductsBlock&) = kernel_at<const ProductsBlock&>("", MARS_KERNELS(bin_products_));
    void (*law)(const LawBlock&) = kernel_at<const LawBlock&>("", MARS_KERNELS(bin_law_));
    TangentSums (*tangent)(const TangentBlock&) =
        kernel_at<const TangentBlock&, TangentSums>("", MARS_KERNELS(bin_tangent_));
    ChangeSums (*change)(const ChangeBlock&) = kernel_at<const ChangeBlock&, ChangeSums>("", MARS_KERNELS(bin_change_));
    double (*cubes)(const CubesBlock&) = kernel_at<const CubesBlock&, double>("", MARS_KERNELS(bin_cubes_));
    void (*series)(const SeriesBlock&) = kernel_at<const SeriesBlock&>("", MARS_KERNELS(background_series_));
};

inline const BinsKernels& bins_kernels() {
    static const BinsKernels kernels;
    return kernels;
}

}  // namespace mars
