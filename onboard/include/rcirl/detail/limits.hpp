// The limits of docs/weights_format.md, far above any sensible reward.
#ifndef RCIRL_DETAIL_LIMITS_HPP_
#define RCIRL_DETAIL_LIMITS_HPP_

#include <cstddef>
#include <cstdint>

namespace rcirl::detail {

constexpr char kMagic[] = "RCIRLW";
constexpr double kTolerance = 1e-5;  // of max(1, |V|), on a verification sample

constexpr std::size_t kMaxFileBytes = 64u << 20;
constexpr std::uint32_t kMaxFeatures = 64;   // F
constexpr std::uint32_t kMaxTimes = 256;     // T
constexpr std::uint32_t kMaxLayers = 16;     // L
constexpr std::uint32_t kMaxUnits = 4096;    // outputs of one layer
constexpr std::uint32_t kMaxSamples = 256;   // verification samples
constexpr std::size_t kMaxName = 64;         // characters of a name or unit
constexpr std::size_t kMaxText = 1u << 16;   // bytes of any other text
constexpr std::uint32_t kMaxItems = 4096;    // entries of one list or map
constexpr std::uint32_t kMaxNodes = 1 << 16; // entries of all lists and maps together
constexpr int kMaxDepth = 8;  // levels of lists and maps, `provenance` itself the first

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_LIMITS_HPP_
