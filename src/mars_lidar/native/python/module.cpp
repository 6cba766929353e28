// The native core `mars_lidar._core`: every file of this folder binds one subject. Bindings check no more than shapes; Python
// validates.
#include "python/bindings.h"

NB_MODULE(_core, module) {
    module.doc() = "Native core of mars_lidar.";
    // At exit PyTorch and pytest still hold references to modules; nanobind would list every function of ours as leaked.
    nanobind::set_leak_warnings(false);
    mars::bind_pulse(module);
    mars::bind_recording(module);
    mars::bind_job(module);
    mars::bind_engines(module);
    mars::bind_exact_device(module);
    mars::bind_mars_device(module);
    mars::bind_feedback_device(module);
    mars::bind_chain(module);
    mars::bind_exposure(module);
    mars::bind_joint(module);
    mars::bind_shape_sampler(module);
    mars::bind_count_draws(module);
    mars::bind_matched(module);
    mars::bind_table(module);
    mars::bind_feedback(module);
    mars::bind_packing(module);
    mars::bind_corrected_rates(module);
    mars::bind_maximum_likelihood(module);
    mars::bind_coarse_likelihood(module);
    mars::bind_calibration(module);
    mars::bind_image(module);
}
