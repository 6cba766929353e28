// Runs numbered chunks of work on threads, while the calling thread looks after them: progress, and Ctrl-C
// (python/watched.h). Where there are no threads (MARS_NO_THREADS: in a browser), one chunk after the other.
#pragma once
#include <atomic>
#include <cstdint>
#include <exception>
#include <functional>
#if !defined(MARS_NO_THREADS)
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>
#endif

#if defined(__linux__)
#include <sched.h>
#endif

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

// Looks after a run from the calling thread: called with the chunks done, and all, every 50 ms and once when all are done.
// Returns whether to stop. May be empty.
using Watch = std::function<bool(int64_t done, int64_t chunks)>;

// Thrown by a run that its watch has stopped.
struct Stopped : std::exception {
    const char* what() const noexcept override { return "stopped"; }
};

// Calls work(chunk, stop) for chunk = 0 .. chunks-1 on `threads` threads, in any order. Where the watch asks for it, or
// `work` throws, `stop` turns true, the threads are joined, and Stopped or the exception is thrown: long chunks must
// poll `stop`.
#if defined(MARS_NO_THREADS)
template <class Work>
void run_chunks(int64_t chunks, int, const Watch&, const Work& work) {
    const std::atomic<bool> stop{false};
    for (int64_t chunk = 0; chunk < chunks; ++chunk) work(chunk, stop);
}
#else
template <class Work>
void run_chunks(int64_t chunks, int threads, const Watch& watch, const Work& work) {
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
    bool stopped = false;
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
    {
        std::unique_lock<std::mutex> lock(mutex);
        while (!wake.wait_for(lock, std::chrono::milliseconds(50), [&] { return running == 0; })) {
            lock.unlock();
            if (!stopped && watch && watch(done.load(), chunks)) stop = stopped = true;
            lock.lock();
        }
    }
    for (std::thread& thread : pool) thread.join();
    if (stopped) throw Stopped();
    if (failure) std::rethrow_exception(failure);
    if (watch && watch(chunks, chunks)) throw Stopped();
}
#endif

}  // namespace mars
