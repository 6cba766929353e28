// What the tasks of kernels on a GPU are made of: addresses of device arrays and numbers by name, and arrays to be copied to
// the device.
#pragma once
#include <algorithm>
#include <cstdint>
#include <string>
#include <type_traits>
#include <vector>

#include "python/bindings.h"

namespace mars {

// The fields of a task by name: a pointer takes an array's address, null where there is none; a number has to be there.
class DeviceFields {
 public:
    explicit DeviceFields(const nb::dict& addresses, const nb::dict& numbers = nb::dict())
        : addresses_(addresses), numbers_(numbers) {}

    // set("signal", task.signal, "pixels", task.pixels, ...)
    template <class T, class... Rest>
    void set(const std::string& name, T& field, Rest&&... rest) const {
        const char* const key = name.c_str();
        if constexpr (std::is_pointer_v<T>) {
            const uint64_t address = addresses_.contains(key) ? nb::cast<uint64_t>(addresses_[key]) : 0;
            field = reinterpret_cast<T>(static_cast<uintptr_t>(address));
        } else {
            field = nb::cast<T>(numbers_[key]);
        }
        if constexpr (sizeof...(rest) > 0) set(std::forward<Rest>(rest)...);
    }

 private:
    const nb::dict addresses_, numbers_;
};

template <class Task>
nb::bytes as_bytes(const Task& task) {
    return nb::bytes(reinterpret_cast<const char*>(&task), sizeof task);
}

// An array to be copied to the device: numbers as they are, structs as bytes.
template <class T>
nb::object copied(const std::vector<T>& from) {
    using Number = std::conditional_t<std::is_arithmetic_v<T>, T, uint8_t>;
    const size_t size = from.size() * sizeof(T) / sizeof(Number);
    Number* data = new Number[size];
    std::copy_n(reinterpret_cast<const Number*>(from.data()), size, data);
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<Number*>(p); });
    return nb::cast(nb::ndarray<nb::numpy, Number, nb::ndim<1>>(data, {size}, owner));
}

// Such arrays by name: arrays_of("tail", tables.tail, ...).
template <class T, class... Rest>
nb::dict arrays_of(const char* name, const std::vector<T>& array, const Rest&... rest) {
    nb::dict out;
    if constexpr (sizeof...(rest) > 0) out = arrays_of(rest...);
    out[name] = copied(array);
    return out;
}

}  // namespace mars
