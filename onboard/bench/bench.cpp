// bench WEIGHTS K CALLS PAUSE_US: time of scoring K candidates, one line for each call.
//
// A line is the wall time and the processor time of a call, in ns. The thread sleeps
// PAUSE_US between calls, as a planner does between cycles; inputs change with the call.
#include <cstdio>
#include <cstdlib>
#include <random>
#include <vector>

#include "rcirl/reward.hpp"
#include "timed.hpp"

int main(int count, char** arguments) {
  rcirl::Reward reward;
  const rcirl::Status status =
      count == 5 ? rcirl::load(arguments[1], &reward)
                 : rcirl::Status("bench: arguments: expected WEIGHTS K CALLS PAUSE_US");
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  constexpr int kSets = 8, kWarmUp = 50;
  const std::size_t candidates = std::strtoul(arguments[2], nullptr, 10);
  const int calls = std::atoi(arguments[3]);
  const std::size_t size = candidates * reward.times().size() * reward.features().size();
  std::mt19937 random(0);
  std::normal_distribution<float> draw(0.0f, 2.0f);
  std::vector<float> features(kSets * size), values(candidates);
  for (float& value : features) value = draw(random);
  rcirl::Workspace workspace = reward.workspace();
  std::size_t refused = 0;
  for (int call = -kWarmUp; call < calls; ++call) {
    const float* set = &features[size * static_cast<std::size_t>((call + kWarmUp) % kSets)];
    timed(call >= 0, std::atol(arguments[4]), [&] {
      refused += reward.score(set, candidates, {}, &workspace, values.data());
    });
  }
  return refused == 0 ? 0 : 1;
}
