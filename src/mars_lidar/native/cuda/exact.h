// The exact engine on a GPU: one thread per item, with the physics of registration.h in plain numbers. The bits are
// those of the processor's engine: the same source, no fused multiply-add, IEEE division.
//
// Threads of a warp run in step, so each waits for the longest exposure of its 32: the host hands out pixels in the
// order of their brightness (mars_lidar/engines/cuda/exact.py), which makes them alike.
#pragma once
#include "cuda/device.h"
#include "exact/step.h"

namespace mars {
inline namespace MARS_LEVEL {

// Where registrations go. Block histograms are counted in 8 bits in the block's memory, every 256th count of a bin goes
// to the row at once: 1 KB an item at 1024 bins, so that as many warps as possible fit into a multiprocessor. Rows of
// too many bins are counted in place.
enum class DeviceSink : int32_t { kCounts, kBlock16, kBlock32, kRows16, kRows32, kTimestamps };

// Passed to the kernel by value; all pointers are the device's.
struct DeviceTask {
    SystemView system;
    double centre;  // of the pulse's frame
    uint64_t seed;
    const double *signal, *delay, *background;  // (returns, pixels), likewise, (pixels)
    const uint32_t* pixel_index;                // (pixels)
    const int32_t* order;                       // (pixels): which pixel goes first
    const int32_t* start_cycle;                 // (items) re-arming times before the exposure, or null: armed at 0
    const float* start_phase;
    void* out;               // counts int64 (items), or rows (items, bins), zero at first
    const int64_t* offsets;  // timestamps: first record of each item
    int32_t* cycles;
    float* phases;
    int64_t pixels, first, items;  // of this launch: [first, first + items) in the order (realization, place)
    uint32_t first_realization, padding;
};

// A thread's eight-bit counters: bin b is byte b % 4 of its word b / 4, and word w of lane l lies at w * lanes + l, so
// that the threads of a warp never meet in a bank.
struct BlockCounters {
    uint8_t* bytes;
    int32_t lanes;

    MARS_INLINE uint8_t* at(int32_t bin) const { return bytes + (bin >> 2) * (4 * lanes) + (bin & 3); }
};

// Adds to a bin of a row in the device's memory.
template <class Count>
MARS_INLINE void count_in_row(Count* row, int32_t bin, uint32_t number) {
    if constexpr (sizeof(Count) == 4) {
        add_later(row + bin, number);
    } else {  // half of a word; the host has made sure that no bin can exceed 65535. A row may begin inside a word.
        const uint64_t place = reinterpret_cast<uint64_t>(row + bin);
        add_later(reinterpret_cast<uint32_t*>(place & ~uint64_t{3}), number << (8 * (place & 2)));
    }
}

// The histogram of one item: a row of the output, counted in place or, with `block`, in the block's memory first.
template <class Count, bool block>
class DeviceHistogram {
 public:
    MARS_INLINE DeviceHistogram(const DeviceTask& task, int64_t item, int32_t lane, int32_t lanes)
        : row_(static_cast<Count*>(task.out) + item * task.system.bins),
          bins_(task.system.bins),
          counters_{block_memory() + 4 * lane, lanes} {
        if constexpr (block)
            for (int32_t b = 0; b < bins_; b += 4) *reinterpret_cast<uint32_t*>(counters_.at(b)) = 0;
    }
    MARS_INLINE void take(const Registration& r, int32_t bin) {
        if (r.lost) return;
        if constexpr (block) {
            uint8_t* counter = counters_.at(bin);
            const uint32_t count = *counter + 1u;
            *counter = static_cast<uint8_t>(count);
            if (count == 256u) {
                row_[bin] = static_cast<Count>(row_[bin] + 256u);
                spilled_ = true;
            }
        } else {
            count_in_row(row_, bin, 1u);
        }
    }
    MARS_INLINE void end() {
        if constexpr (block) {
            // 16 bytes at a time where rows allow it: the second-level cache takes sectors of 32, and 2 bytes each
            // would cost as much as a sector
            constexpr int32_t step = 16 / static_cast<int32_t>(sizeof(Count));
            const bool aligned = bins_ % step == 0 && (reinterpret_cast<uint64_t>(row_) & 15) == 0;
            if (aligned)
                for (int32_t b = 0; b < bins_; b += step) end_aligned(b);
            else
                for (int32_t b = 0; b < bins_; ++b)
                    row_[b] = static_cast<Count>(*counters_.at(b) + (spilled_ ? row_[b] : 0u));
        }
    }

 private:
    struct alignas(16) Words {
        uint32_t word[4];
    };
    MARS_INLINE uint32_t four(int32_t bin) const { return *reinterpret_cast<const uint32_t*>(counters_.at(bin)); }
    MARS_INLINE void end_aligned(int32_t bin) {
        Words out;
        const uint32_t a = four(bin);
        if constexpr (sizeof(Count) == 2) {
            const uint32_t b = four(bin + 4);
            out = {{(a & 255u) | (a >> 8 & 255u) << 16, (a >> 16 & 255u) | (a >> 24) << 16,
                    (b & 255u) | (b >> 8 & 255u) << 16, (b >> 16 & 255u) | (b >> 24) << 16}};
        } else {
            out = {{a & 255u, a >> 8 & 255u, a >> 16 & 255u, a >> 24}};
        }
        Words* to = reinterpret_cast<Words*>(row_ + bin);
        if (spilled_) {  // halves of a word do not overflow: no bin exceeds 65535
            const Words before = *to;
            for (int k = 0; k < 4; ++k) out.word[k] += before.word[k];
        }
        *to = out;
    }

    Count* row_;
    int32_t bins_;
    BlockCounters counters_;
    bool spilled_ = false;
};

class DeviceCounts {
 public:
    MARS_INLINE DeviceCounts(const DeviceTask& task, int64_t item, int32_t, int32_t)
        : out_(static_cast<int64_t*>(task.out) + item) {}
    MARS_INLINE void take(const Registration& r, int32_t) { number_ += r.lost ? 0 : 1; }
    MARS_INLINE void end() { *out_ = number_; }

 private:
    int64_t* out_;
    int64_t number_ = 0;
};

class DeviceTimestamps {
 public:
    MARS_INLINE DeviceTimestamps(const DeviceTask& task, int64_t item, int32_t, int32_t)
        : task_(task), next_(task.offsets[item]) {}
    MARS_INLINE void take(const Registration& r, int32_t) {
        if (r.lost) return;
        task_.cycles[next_] = r.cycle;
        task_.phases[next_] = r.phase;
        ++next_;
    }
    MARS_INLINE void end() {}

 private:
    const DeviceTask& task_;
    int64_t next_;
};

template <DeviceSink sink>
struct DeviceWriter;
template <>
struct DeviceWriter<DeviceSink::kCounts> {
    using Type = DeviceCounts;
};
template <>
struct DeviceWriter<DeviceSink::kBlock16> {
    using Type = DeviceHistogram<uint16_t, true>;
};
template <>
struct DeviceWriter<DeviceSink::kBlock32> {
    using Type = DeviceHistogram<uint32_t, true>;
};
template <>
struct DeviceWriter<DeviceSink::kRows16> {
    using Type = DeviceHistogram<uint16_t, false>;
};
template <>
struct DeviceWriter<DeviceSink::kRows32> {
    using Type = DeviceHistogram<uint32_t, false>;
};
template <>
struct DeviceWriter<DeviceSink::kTimestamps> {
    using Type = DeviceTimestamps;
};

MARS_INLINE Rate device_rate(double photons) {
    Rate flux;
    plain_rate(photons, flux.rate, flux.inverse);
    return flux;
}

// `single`: one return at most, which then stays in registers. `ahead`: registrations drawn ahead (the bits do not
// depend on it).
template <int32_t mode_number, bool gaussian, bool whole, bool single, int32_t sink_number, int32_t ahead>
MARS_KERNEL exact_items(const DeviceTask task) {
    constexpr DetectorMode mode = static_cast<DetectorMode>(mode_number);
    constexpr PulseKind kind = gaussian ? PulseKind::kGaussian : PulseKind::kSampled;
    const DevicePlace place = device_place();
    if (place.thread >= task.items) return;
    SystemView system = task.system;
    if constexpr (single) system.returns = 1;

    const int64_t number = task.first + place.thread, turn = number / task.pixels;
    const int32_t pixel = task.order[number - turn * task.pixels];
    const int64_t item = turn * task.pixels + pixel;
    const double first_delay = task.delay[pixel];
    const float delay = wrapped(first_delay + task.centre);
    const Rate background = device_rate(task.background[pixel]);
    Return returns[single ? 1 : kMaxReturns];
    for (int32_t k = 0; k < system.returns; ++k) {
        const int64_t at = k * task.pixels + pixel;
        returns[k] = {device_rate(task.signal[at]), offset_of(task.delay[at], first_delay)};
    }
    Time armed;
    start_in_frames(task.start_cycle ? task.start_cycle[item] : 0, task.start_cycle ? task.start_phase[item] : 0.0f,
                    delay, armed.frame, armed.phase);
    const Pair<uint32_t> key =
        stream_key(task.seed, task.first_realization + static_cast<uint32_t>(turn), task.pixel_index[pixel]);
    WordStream<uint32_t> stream = word_stream(key);
    Memory memory = {false, 0, 0.0f};
    typename DeviceWriter<static_cast<DeviceSink>(sink_number)>::Type writer(task, item, place.lane, place.lanes);

    for (uint32_t event = 0; armed.frame <= system.cycles; event += ahead) {
        Draw drawn[ahead];
        MARS_UNROLL
        for (int k = 0; k < ahead; ++k)
            drawn[k] =
                draw(background, returns[0].flux, stream, key.first, key.second, event + static_cast<uint32_t>(k));
        MARS_UNROLL
        for (int k = 0; k < ahead; ++k) {
            const Registration next =
                register_next<mode, kind, whole>(system, returns, delay, drawn[k], key.first, key.second,
                                                 event + static_cast<uint32_t>(k), armed, memory);
            writer.take(next, bin_of(next.phase, system.bins));
        }
    }
    writer.end();
}

}  // namespace MARS_LEVEL
}  // namespace mars
