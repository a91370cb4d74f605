// What the fuzz targets share: an assertion, and numbers from the bytes of an input.
#ifndef RCIRL_FUZZ_BITS_HPP_
#define RCIRL_FUZZ_BITS_HPP_

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <cstring>

inline void require(bool good) {
  if (!good) std::abort();
}

// Numbers from bytes, from the start again where they end.
struct Bits {
  const std::uint8_t* data;
  std::size_t size, at;
  bool folded;  // into a range that roads have

  std::uint8_t byte() { return data[at++ % size]; }

  template <typename Number>
  Number raw() {
    std::uint8_t bytes[sizeof(Number)];
    for (std::uint8_t& one : bytes) one = byte();
    Number value;
    std::memcpy(&value, bytes, sizeof value);
    return value;
  }
};

#endif  // RCIRL_FUZZ_BITS_HPP_
