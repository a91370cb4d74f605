// bench_features WHAT WEIGHTS CASES CALLS PAUSE_US: a line for each call. WHAT is "features",
// F and scores; or "choose", the safety filter, F, scores and the choice.
//
// CASES holds scenes with candidates (tests/flat.hpp, float32); calls take turns. A line is
// the wall time and the processor time of a call, in ns.
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <vector>

#include "../tests/flat.hpp"
#include "rcirl/choose.hpp"
#include "timed.hpp"

int main(int count, char** arguments) {
  rcirl::Reward reward;
  rcirl::FeatureMap columns;
  rcirl::Chooser chooser;
  rcirl::Status status = rcirl::Status("bench_features: arguments: expected five");
  if (count == 6) status = rcirl::load(arguments[2], &reward);
  if (status.ok()) status = rcirl::chooser(reward, {}, &chooser);
  if (status.ok()) status = rcirl::feature_map(reward, &columns);
  std::vector<float> numbers;
  if (status.ok()) {
    std::FILE* stream = std::fopen(arguments[3], "rb");
    float number;
    while (stream != nullptr && std::fread(&number, 4, 1, stream) == 1) numbers.push_back(number);
    if (stream != nullptr) std::fclose(stream);
  }
  std::vector<Case> cases;
  Numbers source = {numbers.data(), numbers.data() + numbers.size()};
  while (source.at != source.end) {
    cases.emplace_back();
    if (!take_case(source, &cases.back())) break;
  }
  if (status.ok() && (cases.empty() || source.at != source.end)) {
    status = rcirl::Status("CASES: expected scenes with candidates");
  }
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  constexpr int kWarmUp = 50;
  const int calls = std::atoi(arguments[4]);
  const bool chooses = std::strcmp(arguments[1], "choose") == 0;
  const std::size_t most = cases[0].candidates().count;
  std::vector<float> features(most * rcirl::kTimes * columns.size()), values(most);
  rcirl::Workspace workspace = reward.workspace();
  std::size_t refused = 0;
  for (int call = -kWarmUp; call < calls; ++call) {
    const Case& one = cases[static_cast<std::size_t>(call + kWarmUp) % cases.size()];
    const rcirl::Candidates candidates = one.candidates();
    if (candidates.count > most) return 2;
    timed(call >= 0, std::atol(arguments[5]), [&] {
      if (chooses) {
        refused += chooser.choose(one.scene, candidates).outcome > rcirl::Outcome::kNoneAdmissible;
        return;
      }
      refused += columns.compute(one.scene, candidates, features.data());
      refused += reward.score(features.data(), candidates.count, columns.mask(one.scene),
                              &workspace, values.data());
    });
  }
  return refused == 0 ? 0 : 1;
}
