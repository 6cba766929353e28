// What the tasks of kernels on a GPU are made of: addresses of device arrays and numbers by name, and arrays to be copied to
// the device.
#pragma once
#include <algorithm>
#include <cstdint>
#include <string>
#include <vector>

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

template <class T>
nb::object copied(const std::vector<T>& from) {
    T* data = new T[from.size()];
    std::copy(from.begin(), from.end(), data);
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, T, nb::ndim<1>>(data, {from.size()}, owner));
}

}  // namespace mars
