// What the Python tests compare with the Python reader.
//
//   reader score WEIGHTS FEATURES [MASK]  -> float32 values of float32 [K, T, F] and, if
//                                            given, of uint8 [K, T]
//   reader check BATCH                    -> for each file of BATCH, its bytes after
//                                            their number as uint64, "ok" or its refusal
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <string>
#include <string_view>
#include <vector>

#include "rcirl/reward.hpp"

namespace {

std::vector<char> contents(const char* path) {
  std::vector<char> all, chunk(1 << 16);
  std::FILE* stream = std::fopen(path, "rb");
  if (stream == nullptr) return all;
  for (std::size_t read; (read = std::fread(chunk.data(), 1, chunk.size(), stream)) > 0;) {
    all.insert(all.end(), chunk.begin(), chunk.begin() + static_cast<long>(read));
  }
  std::fclose(stream);
  return all;
}

int score(const char* weights, const char* input, const char* mask) {
  rcirl::Reward reward;
  const rcirl::Status status = rcirl::load(weights, &reward);
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  const std::vector<char> bytes = contents(input);
  const std::vector<char> marks = mask == nullptr ? std::vector<char>() : contents(mask);
  std::vector<float> features(bytes.size() / 4);
  std::memcpy(features.data(), bytes.data(), 4 * features.size());
  const std::size_t row = reward.times().size() * reward.features().size();
  std::vector<float> values(features.size() / row);
  rcirl::Mask valid;
  if (mask != nullptr) {
    valid = {reinterpret_cast<const std::uint8_t*>(marks.data()), rcirl::Mask::kEach};
  }
  rcirl::Workspace workspace = reward.workspace();
  reward.score(features.data(), values.size(), valid, &workspace, values.data());
  return std::fwrite(values.data(), 4, values.size(), stdout) == values.size() ? 0 : 1;
}

int check(const char* batch) {
  const std::vector<char> bytes = contents(batch);
  for (std::size_t at = 0; at + 8 <= bytes.size();) {
    std::uint64_t size;
    std::memcpy(&size, &bytes[at], 8);
    // A copy of its own size, so that a sanitizer sees the first byte read too many.
    const std::vector<char> file(bytes.data() + at + 8, bytes.data() + at + 8 + size);
    rcirl::Reward reward;
    const rcirl::Status status =
        rcirl::decode(std::string_view(file.data(), file.size()), "w", &reward);
    std::printf("%s\n", status.ok() ? "ok" : status.message().c_str());
    at += 8 + size;
  }
  return 0;
}

}  // namespace

int main(int count, char** arguments) {
  const std::string mode = count > 1 ? arguments[1] : "";
  if (mode == "check" && count == 3) return check(arguments[2]);
  if (mode == "score" && (count == 4 || count == 5)) {
    return score(arguments[2], arguments[3], count == 5 ? arguments[4] : nullptr);
  }
  std::fprintf(stderr, "reader: arguments: expected score WEIGHTS FEATURES [MASK] | check BATCH\n");
  return 2;
}
