// Runs numbered chunks of work on threads while the calling thread keeps Python alive.
#pragma once
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

#if defined(__linux__)
#include <sched.h>
#endif

#include <nanobind/nanobind.h>

namespace mars {

// Puts the calling thread, the k-th of a team, on a processor of its own, from which the system may move it at once.
// Without that two threads that begin together often share one for the 4 ms until the scheduler looks again, a quarter
// of the time of a cube.
inline void spread_out(int k) {
#if defined(__linux__)
    cpu_set_t allowed, one;
    if (sched_getaffinity(0, sizeof allowed, &allowed) != 0) return;  // more processors than the set holds
    const int count = CPU_COUNT(&allowed);
    if (count < 2) return;
    int left = k % count, cpu = 0;
    while (!CPU_ISSET(cpu, &allowed) || left-- > 0) ++cpu;
    CPU_ZERO(&one);
    CPU_SET(cpu, &one);
    if (sched_setaffinity(0, sizeof one, &one) == 0) sched_setaffinity(0, sizeof allowed, &allowed);
#else
    static_cast<void>(k);
#endif
}

// Calls work(chunk, stop) for chunk = 0 .. chunks-1 on `threads` threads, in any order. The GIL is released;
// every 50 ms the calling thread looks for Ctrl-C and calls progress(done, chunks) unless it is None. On a
// signal, or an exception from work or progress, `stop` turns true, the threads are joined and the exception
// is raised: long chunks must poll `stop`. Work must not touch Python.
template <class Work>
void run_chunks(int64_t chunks, int threads, const nanobind::object& progress, const Work& work) {
    namespace nb = nanobind;
    std::atomic<int64_t> next{0}, done{0};
    std::atomic<bool> stop{false};
    std::exception_ptr failure;
    std::mutex mutex;
    std::condition_variable wake;
    int running = 0;

    auto worker = [&](int k) {
        if (threads > 1) spread_out(k);
        try {
            while (!stop.load(std::memory_order_relaxed)) {
                const int64_t chunk = next.fetch_add(1);
                if (chunk >= chunks) break;
                work(chunk, stop);
                done.fetch_add(1);
            }
        } catch (...) {
            const std::lock_guard<std::mutex> lock(mutex);
            if (!failure) failure = std::current_exception();
            stop = true;
        }
        const std::lock_guard<std::mutex> lock(mutex);
        if (--running == 0) wake.notify_all();
    };

    const int team = static_cast<int>(threads < chunks ? threads : chunks);
    std::vector<std::thread> pool;
    bool interrupted = false;
    {
        nb::gil_scoped_release release;
        {
            const std::lock_guard<std::mutex> lock(mutex);
            try {
                for (int k = 0; k < team; ++k) {
                    ++running;
                    pool.emplace_back(worker, k);
                }
            } catch (...) {  // no more threads to be had: carry on with those there are, if any
                --running;
                if (pool.empty()) throw;
            }
        }
        std::unique_lock<std::mutex> lock(mutex);
        while (!wake.wait_for(lock, std::chrono::milliseconds(50), [&] { return running == 0; })) {
            lock.unlock();
            {
                nb::gil_scoped_acquire acquire;
                if (!interrupted && PyErr_CheckSignals() != 0) {
                    interrupted = true;
                    stop = true;
                } else if (!interrupted && !progress.is_none()) {
                    try {
                        progress(done.load(), chunks);
                    } catch (nb::python_error& error) {
                        error.restore();
                        interrupted = true;
                        stop = true;
                    }
                }
            }
            lock.lock();
        }
        lock.unlock();
        for (std::thread& thread : pool) thread.join();
    }
    if (interrupted) throw nb::python_error();
    if (failure) std::rethrow_exception(failure);
    if (!progress.is_none()) progress(chunks, chunks);
}

}  // namespace mars
