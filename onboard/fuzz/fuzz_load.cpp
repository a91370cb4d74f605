// libFuzzer target: any bytes are refused with one line, or score without harm.
//
// The first byte chooses what the rest is: even a whole file, odd the body of a file,
// wrapped with the right hash (which no mutation would hit).
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string>
#include <string_view>
#include <vector>

#include "bits.hpp"
#include "rcirl/guard.hpp"
#include "rcirl/reward.hpp"

namespace {

std::string sealed(std::string_view body) {
  std::string file = "\x84\xa5magic\xa6RCIRLW\xaeschema_version\x01\xa4" "body\xc6";
  for (int shift = 24; shift >= 0; shift -= 8) file += static_cast<char>(body.size() >> shift);
  file += body;
  file += "\xa6sha256\xd9\x40";
  return file + rcirl::detail::sha256_hex(body.data(), body.size());
}

// Features of any bits, a mask of any bits: values are finite, or -infinity and counted.
void score(const rcirl::Reward& reward, std::string_view bits) {
  constexpr std::size_t kCount = 3;
  const std::size_t times = reward.times().size();
  std::vector<float> features(kCount * times * reward.features().size());
  std::vector<std::uint8_t> marks(kCount * times);
  for (std::size_t i = 0; i < features.size(); ++i) {
    const std::size_t at = 4 * i % bits.size();
    std::memcpy(&features[i], &bits[at], std::min<std::size_t>(4, bits.size() - at));
  }
  for (std::size_t i = 0; i < marks.size(); ++i) {
    marks[i] = static_cast<std::uint8_t>(bits[i % bits.size()] & 1);
  }
  rcirl::Workspace workspace = reward.workspace();
  const rcirl::Mask masks[] = {{nullptr, rcirl::Mask::kShared},
                               {marks.data(), rcirl::Mask::kShared},
                               {marks.data(), rcirl::Mask::kEach}};
  for (const rcirl::Mask mask : masks) {
    const rcirl::Verdict verdict = rcirl::Guard(reward).check(features.data(), kCount, mask);
    require(verdict.feature < reward.features().size());
    require(verdict.share >= 0.0 && verdict.share <= 1.0);
    float values[kCount];
    const std::size_t refused =
        reward.score(features.data(), kCount, mask, &workspace, values);
    std::size_t none = 0;
    for (const float value : values) {
      require(!std::isnan(value) && value != std::numeric_limits<float>::infinity());
      none += std::isinf(value);
    }
    require(none == refused);
    const std::size_t more =
        reward.total(features.data(), kCount, mask, features.data(), &workspace, values);
    none = 0;
    for (const float value : values) {
      require(!std::isnan(value) && value != std::numeric_limits<float>::infinity());
      none += std::isinf(value);
    }
    require(none == more && (reward.has_prior_cost() ? more >= refused : more == kCount));
  }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 1) return 0;
  const std::string_view rest(reinterpret_cast<const char*>(data) + 1, size - 1);
  const std::string file = data[0] % 2 == 0 ? std::string(rest) : sealed(rest);
  rcirl::Reward reward;
  const rcirl::Status status = rcirl::decode(file, "fuzz", &reward);
  if (status.ok()) {
    score(reward, file);
  } else {
    require(status.message().rfind("fuzz: ", 0) == 0);
    require(status.message().find(": expected ") != std::string::npos);
    require(status.message().find_first_of("\r\n") == std::string::npos);
  }
  return 0;
}
