// What hosts of kernels share: arguments from arrays and numbers by name, and a launch as a loop on the processor.
#pragma once
#include <algorithm>
#include <cstring>
#include <string>
#include <vector>

#include "cuda/device.h"
#include "python/bindings.h"

namespace mars {

// Addresses of a task's arrays by name, 0 where there is none; and its numbers, which have to be there.
class DeviceFields {
 public:
    DeviceFields(const nb::dict& addresses, const nb::dict& numbers) : addresses_(addresses), numbers_(numbers) {}

    template <class T>
    T* at(const std::string& name) const {
        const uint64_t address = addresses_.contains(name.c_str()) ? nb::cast<uint64_t>(addresses_[name.c_str()]) : 0;
        return reinterpret_cast<T*>(static_cast<uintptr_t>(address));
    }
    int64_t integer(const char* name) const { return nb::cast<int64_t>(numbers_[name]); }
    uint64_t word(const char* name) const { return nb::cast<uint64_t>(numbers_[name]); }
    double real(const char* name) const { return nb::cast<double>(numbers_[name]); }

 private:
    const nb::dict &addresses_, &numbers_;
};

template <class Task>
nb::bytes as_bytes(const Task& task) {
    return nb::bytes(reinterpret_cast<const char*>(&task), sizeof task);
}

template <class Task>
Task argument_of(const nb::bytes& told) {
    if (told.size() != sizeof(Task)) throw nb::value_error("argument must be that of the kernel");
    Task task;
    std::memcpy(&task, told.c_str(), sizeof task);
    return task;
}

template <class T>
nb::object copied(const std::vector<T>& from) {
    T* data = new T[from.size()];
    std::copy(from.begin(), from.end(), data);
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, T, nb::ndim<1>>(data, {from.size()}, owner));
}

inline namespace MARS_LEVEL {

// Blocks one after another, `at_once` threads of each; the blocks' memory holds anything when one begins.
struct HostLaunch {
    int64_t blocks;
    int32_t lanes;
    int64_t shared;

    template <class Kernel, class Task>
    void operator()(const Kernel& kernel, const Task& task, int32_t at_once) const {
        std::vector<uint64_t> memory(static_cast<size_t>(shared / 8 + 16));
        uint8_t* const begin = reinterpret_cast<uint8_t*>((reinterpret_cast<uintptr_t>(memory.data()) + 63) / 64 * 64);
        for (int64_t block = 0; block < blocks; ++block) {
            std::fill(memory.begin(), memory.end(), 0xdeadbeefdeadbeefu);
            for (int32_t lane = 0; lane < at_once; ++lane) {
                host_device = {{block * lanes + lane, lane, lanes}, begin};
                kernel(task);
            }
        }
    }
};

}  // namespace MARS_LEVEL

}  // namespace mars
