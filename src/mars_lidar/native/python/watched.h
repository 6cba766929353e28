// Long work called from Python: without the interpreter's lock, stopped by Ctrl-C, and with calls of `progress`.
#pragma once
#include <algorithm>

#include <nanobind/nanobind.h>

#include "base/parallel.h"

namespace mars {

// Calls run(watch) with the interpreter's lock released. The watch calls progress(done, chunks) unless it is None; what
// that raises, and Ctrl-C, stop the run and are raised here. `run` must not touch Python.
template <class Run>
void watched(const nanobind::object& progress, const Run& run) {
    namespace nb = nanobind;
    bool raised = false;
    const Watch watch = [&](int64_t done, int64_t chunks) {
        if (done == chunks && progress.is_none()) return false;  // nothing to tell: do not wait for the lock
        const nb::gil_scoped_acquire acquire;
        if (PyErr_CheckSignals() != 0) return raised = true;
        if (progress.is_none()) return false;
        try {
            progress(done, chunks);
        } catch (nb::python_error& error) {
            error.restore();
            raised = true;
        }
        return raised;
    };
    try {
        const nb::gil_scoped_release release;
        run(watch);
    } catch (const Stopped&) {
        if (!raised) throw;
    }
    if (raised) throw nb::python_error();
}

// Items in chunks: `begin()` gives what works on those of one chunk, called with each.
template <class Begin>
void run_watched_items(int64_t items, int64_t chunk, int threads, const nanobind::object& progress,
                       const Begin& begin) {
    watched(progress, [&](const Watch& watch) {
        run_chunks((items + chunk - 1) / chunk, threads, watch, [&](int64_t number, const std::atomic<bool>& stop) {
            auto work = begin();
            const int64_t end = std::min(items, (number + 1) * chunk);
            for (int64_t item = number * chunk; item < end && !stop; ++item) work(item);
        });
    });
}

// run_chunks for a caller that holds the interpreter's lock.
template <class Work>
void run_watched_chunks(int64_t chunks, int threads, const nanobind::object& progress, const Work& work) {
    watched(progress, [&](const Watch& watch) { run_chunks(chunks, threads, watch, work); });
}

}  // namespace mars
