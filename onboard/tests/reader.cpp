// What the Python tests compare with the Python reader.
//
//   reader score WEIGHTS FEATURES [MASK]  -> float32 values of float32 [K, T, F] and, if
//                                            given, of uint8 [K, T]
//   reader total WEIGHTS FEATURES OWN [MASK]  -> as score, on top of float32 values OWN [K]
//   reader guard WEIGHTS FEATURES [MASK]  -> of each plan of 4 candidates "0 or 1, the
//                                            feature's place, its share"
//   reader features WEIGHTS CASES         -> for each case of CASES (tests/flat.hpp, float32)
//                                            float32 features [K, T, F] and scores [K]
//   reader admit CASES                    -> for each case float32 rulings [K, 3]: reason,
//                                            obstacle and time, -1 if none; with offsets, those
//                                            of lanes that are entered too
//   reader choose GUARD WEIGHTS CASES [OWN]  -> for each case "best, K if none" and why, a line;
//                                            then of each candidate its value and why not.
//                                            OWN: float32 own values, case after case
//   reader describe WEIGHTS               -> what the reward says of itself
//   reader check BATCH                    -> for each file of BATCH, its bytes after
//                                            their number as uint64, "ok" or its refusal
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <string>
#include <string_view>
#include <vector>

#include "flat.hpp"
#include "rcirl/choose.hpp"
#include "rcirl/features.hpp"
#include "rcirl/guard.hpp"
#include "rcirl/reward.hpp"
#include "rcirl/safety.hpp"

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

// A reward with candidates to judge.
struct Given {
  rcirl::Reward reward;
  std::vector<float> features;
  std::vector<char> marks;
  std::size_t row = 0, count = 0;  // numbers of a candidate, candidates

  bool read(const char* weights, const char* input, const char* mask) {
    const rcirl::Status status = rcirl::load(weights, &reward);
    if (!status.ok()) {
      std::fprintf(stderr, "%s\n", status.message().c_str());
      return false;
    }
    const std::vector<char> bytes = contents(input);
    if (mask != nullptr) marks = contents(mask);
    features.resize(bytes.size() / 4);
    std::memcpy(features.data(), bytes.data(), 4 * features.size());
    row = reward.times().size() * reward.features().size();
    count = features.size() / row;
    return true;
  }

  rcirl::Mask mask(std::size_t first) const {
    if (marks.empty()) return {};
    const char* from = marks.data() + first * reward.times().size();
    return {reinterpret_cast<const std::uint8_t*>(from), rcirl::Mask::kEach};
  }
};

int score(const Given& given) {
  std::vector<float> values(given.count);
  rcirl::Workspace workspace = given.reward.workspace();
  given.reward.score(given.features.data(), given.count, given.mask(0), &workspace,
                     values.data());
  return std::fwrite(values.data(), 4, values.size(), stdout) == values.size() ? 0 : 1;
}

int total(const Given& given, const char* own) {
  const std::vector<char> bytes = contents(own);
  std::vector<float> values(given.count);
  if (bytes.size() != 4 * values.size()) return 2;
  if (!values.empty()) std::memcpy(values.data(), bytes.data(), bytes.size());
  rcirl::Workspace workspace = given.reward.workspace();
  given.reward.total(given.features.data(), given.count, given.mask(0), values.data(), &workspace,
                     values.data());
  return std::fwrite(values.data(), 4, values.size(), stdout) == values.size() ? 0 : 1;
}

int guard(const Given& given) {
  constexpr std::size_t kPlan = 4;  // candidates
  const rcirl::Guard guard(given.reward);
  for (std::size_t first = 0; first + kPlan <= given.count; first += kPlan) {
    const rcirl::Verdict found =
        guard.check(&given.features[first * given.row], kPlan, given.mask(first));
    std::printf("%d %zu %.17g\n", found.in_distribution, found.feature, found.share);
  }
  return 0;
}

bool write(const std::vector<float>& values) {
  return std::fwrite(values.data(), 4, values.size(), stdout) == values.size();
}

std::vector<float> floats(const char* path) {
  const std::vector<char> bytes = contents(path);
  std::vector<float> numbers(bytes.size() / 4);
  if (!numbers.empty()) std::memcpy(numbers.data(), bytes.data(), 4 * numbers.size());
  return numbers;
}

int admit(const char* cases) {
  const std::vector<float> numbers = floats(cases);
  Numbers source = {numbers.data(), numbers.data() + numbers.size()};
  Case one;
  while (source.at != source.end) {
    if (!take_case(source, &one)) return 2;
    const rcirl::Candidates candidates = one.candidates();
    std::vector<rcirl::Ruling> rulings(candidates.count);
    rcirl::SafetyLimits limits;
    limits.entry = candidates.l != nullptr;
    rcirl::admit(one.scene, candidates, limits, rulings.data());
    std::vector<float> found;
    for (const rcirl::Ruling& ruling : rulings) {
      const bool named = ruling.obstacle != rcirl::Ruling::kNobody;
      found.push_back(static_cast<float>(ruling.reason));
      found.push_back(named ? static_cast<float>(ruling.obstacle) : -1.0f);
      found.push_back(std::isfinite(ruling.time) ? ruling.time : -1.0f);
    }
    if (!write(found)) return 1;
  }
  return 0;
}

int choose(const char* guard, const char* weights, const char* cases, const char* own) {
  rcirl::Reward reward;
  rcirl::Chooser chooser;
  rcirl::Status status = rcirl::load(weights, &reward);
  rcirl::ChooseOptions options;
  options.guard = std::strcmp(guard, "guard") == 0;
  if (status.ok()) status = rcirl::chooser(reward, options, &chooser);
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  const std::vector<float> numbers = floats(cases), given = own ? floats(own) : numbers;
  Numbers source = {numbers.data(), numbers.data() + numbers.size()};
  const float* next = own != nullptr ? given.data() : nullptr;
  Case one;
  while (source.at != source.end) {
    if (!take_case(source, &one)) return 2;
    const rcirl::Candidates candidates = one.candidates();
    const rcirl::Choice choice = chooser.choose(one.scene, candidates, next);
    if (next != nullptr) next += candidates.count;
    std::printf("%zu %s\n", choice.best, chooser.why().c_str());
    for (std::size_t k = 0; k < candidates.count; ++k) {
      std::printf("%.9g %s\n", static_cast<double>(chooser.values()[k]),
                  text(chooser.rulings()[k]).c_str());
    }
  }
  return 0;
}

int describe(const char* weights) {
  rcirl::Reward reward;
  const rcirl::Status status = rcirl::load(weights, &reward);
  std::printf("%s\n", status.ok() ? describe(reward).c_str() : status.message().c_str());
  return status.ok() ? 0 : 2;
}

int features(const char* weights, const char* cases) {
  rcirl::Reward reward;
  rcirl::FeatureMap columns;
  rcirl::Status status = rcirl::load(weights, &reward);
  if (status.ok()) status = rcirl::feature_map(reward, &columns);
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  const std::vector<float> numbers = floats(cases);
  Numbers source = {numbers.data(), numbers.data() + numbers.size()};
  rcirl::Workspace workspace = reward.workspace();
  Case one;
  while (source.at != source.end) {
    if (!take_case(source, &one)) return 2;
    status = rcirl::check(one.scene);
    if (!status.ok()) {
      std::fprintf(stderr, "%s\n", status.message().c_str());
      return 2;
    }
    const rcirl::Candidates candidates = one.candidates();
    std::vector<float> found(candidates.count * rcirl::kTimes * columns.size());
    std::vector<float> scores(candidates.count);
    columns.compute(one.scene, candidates, found.data());
    reward.score(found.data(), candidates.count, columns.mask(one.scene), &workspace,
                 scores.data());
    if (!write(found) || !write(scores)) return 1;
  }
  return 0;
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
  if (mode == "admit" && count == 3) return admit(arguments[2]);
  if (mode == "choose" && (count == 5 || count == 6)) {
    return choose(arguments[2], arguments[3], arguments[4], count == 6 ? arguments[5] : nullptr);
  }
  if (mode == "describe" && count == 3) return describe(arguments[2]);
  if (mode == "features" && count == 4) return features(arguments[2], arguments[3]);
  if ((mode == "score" || mode == "guard") && (count == 4 || count == 5)) {
    Given given;
    if (!given.read(arguments[2], arguments[3], count == 5 ? arguments[4] : nullptr)) return 2;
    return mode == "score" ? score(given) : guard(given);
  }
  if (mode == "total" && (count == 5 || count == 6)) {
    Given given;
    if (!given.read(arguments[2], arguments[3], count == 6 ? arguments[5] : nullptr)) return 2;
    return total(given, arguments[4]);
  }
  std::fprintf(stderr,
               "reader: arguments: expected score or guard WEIGHTS FEATURES [MASK] | "
               "total WEIGHTS FEATURES OWN [MASK] | features WEIGHTS CASES | admit CASES | "
               "choose GUARD WEIGHTS CASES [OWN] | describe WEIGHTS | check BATCH\n");
  return 2;
}
