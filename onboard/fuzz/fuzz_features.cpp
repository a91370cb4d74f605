// libFuzzer target: a scene and candidates of any bits give features and rulings without harm.
//
// The first byte chooses how numbers are read: 0 as they are, 1 folded into a range that
// roads have, so that scenes pass the check. The second is the number of obstacles.
#include <cmath>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "bits.hpp"
#include "rcirl/choose.hpp"
#include "rcirl/features.hpp"

namespace {

struct Floats : Bits {
  float number() {
    const float value = raw<float>();
    if (!folded) return value;
    return std::isfinite(value) ? std::fmod(value, 200.0f) : 1.0f;
  }

  template <typename Array>
  void fill(Array* values) {
    for (float& value : *values) value = number();
  }
};

rcirl::Obstacle obstacle(Floats* bits) {
  rcirl::Obstacle box;
  box.kind = static_cast<rcirl::ObstacleKind>(bits->byte() % (bits->folded ? 7 : 256));
  for (rcirl::Times* table :
       {&box.s_lower, &box.s_upper, &box.l_lower, &box.l_upper, &box.speed}) {
    bits->fill(table);
  }
  for (std::size_t t = 0; t < rcirl::kTimes; ++t) {
    box.valid[t] = static_cast<std::uint8_t>(bits->byte() % (bits->folded ? 2 : 256));
    if (!bits->folded) continue;
    if (box.s_lower[t] > box.s_upper[t]) std::swap(box.s_lower[t], box.s_upper[t]);
    if (box.l_lower[t] > box.l_upper[t]) std::swap(box.l_lower[t], box.l_upper[t]);
  }
  return box;
}

rcirl::Scene scene(Floats* bits, std::size_t obstacles) {
  rcirl::Scene made;
  float* const ego[] = {&made.ego.s, &made.ego.l, &made.ego.dl,     &made.ego.ddl,
                        &made.ego.v, &made.ego.a, &made.ego.length, &made.ego.width};
  for (float* number : ego) *number = bits->number();
  bits->fill(&made.path.kappa);
  bits->fill(&made.path.l);
  bits->fill(&made.path.speed_limit);
  bits->fill(&made.path.road_left);
  bits->fill(&made.path.road_right);
  made.num_valid = bits->folded ? 1 + bits->byte() % rcirl::kTimes : bits->byte();
  if (bits->folded) {
    made.ego.length = 0.1f + std::abs(made.ego.length);
    made.ego.width = 0.1f + std::abs(made.ego.width);
    for (float& kappa : made.path.kappa) kappa *= 1e-3f;
    for (float& limit : made.path.speed_limit) limit = std::abs(limit);
    for (std::size_t p = 0; p < rcirl::kStations; ++p) {
      float &left = made.path.road_left[p], &right = made.path.road_right[p];
      if (left < right) std::swap(left, right);
    }
  }
  for (std::size_t n = 0; n < obstacles; ++n) made.obstacles.push_back(obstacle(bits));
  return made;
}

rcirl::FeatureMap every_column() {
  std::vector<rcirl::Feature> features;
  for (const auto& column : rcirl::detail::kColumns) {
    features.push_back({column.name, column.unit, 0.0});
  }
  rcirl::FeatureMap map;
  require(rcirl::feature_map(features, "fuzz", &map).ok());
  return map;
}

// Of a scene that passed, and a candidate that has positions.
void check_row(const float* row) {
  namespace d = rcirl::detail;
  for (const d::Column c : {d::kFollowDistance, d::kOvertakeDistance, d::kSidepassFrontDistance,
                            d::kSidepassRearDistance}) {
    require(row[c] >= 0.0f && row[c] <= d::kObstacleCapM);
  }
  for (const d::Column c : {d::kStopDistance, d::kVirtualDistance, d::kNudgeDistance}) {
    require(row[c] >= 0.0f && row[c] <= d::kLineCapM);
  }
  require(row[d::kNudgeLateral] >= d::kLateralBufferM && row[d::kNudgeLateral] <= 10.0f);
  require(row[d::kCollisionDistance] >= d::kMinCollisionM);
  require(row[d::kCollisionDistance] <= d::kObstacleCapM);
  require((row[d::kCollision] == 1.0f) == (row[d::kCollisionDistance] < 0.0f));
}

// A ruling for each candidate, with an obstacle and a time that are there.
void check_rulings(const rcirl::Scene& made, const rcirl::Candidates& candidates, bool fine) {
  std::vector<rcirl::Ruling> rulings(candidates.count);
  const std::size_t admissible = rcirl::admit(made, candidates, {}, rulings.data());
  std::size_t count = 0;
  for (const rcirl::Ruling& ruling : rulings) {
    count += ruling.admissible();
    require(ruling.admissible() == text(ruling).empty());
    require(fine || ruling.reason == rcirl::Reason::kNoNumber);
    const bool named = ruling.obstacle != rcirl::Ruling::kNobody;
    require(!named || ruling.obstacle < made.obstacles.size());
    require(!std::isfinite(ruling.time) || (ruling.time >= 0.0f && ruling.time <= 8.0f));
  }
  require(count == admissible);
  rcirl::Chooser none;
  require(!none.choose(made, candidates).found() && !none.why().empty());
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  if (size < 3) return 0;
  static const rcirl::FeatureMap columns = every_column();
  constexpr std::size_t kCount = 5;
  Floats bits = {{data + 2, size - 2, 0, data[0] % 2 == 1}};
  const rcirl::Scene made = scene(&bits, data[1] % 6);
  std::vector<float> s(kCount * rcirl::kTimes), l(s.size());
  bits.fill(&s);
  bits.fill(&l);
  const rcirl::Status status = rcirl::check(made);
  if (!status.ok()) {
    require(status.message().rfind("scene: ", 0) == 0);
    require(status.message().find(": expected ") != std::string::npos);
    require(status.message().find_first_of("\r\n") == std::string::npos);
  }
  require(status.ok() || !bits.folded);
  const std::size_t row = rcirl::kTimes * columns.size();
  std::vector<float> features(kCount * row);
  const float* const ways[] = {nullptr, l.data()};
  for (const float* offsets : ways) {
    const std::size_t refused =
        columns.compute(made, {s.data(), offsets, kCount}, features.data());
    std::size_t unknown = 0;
    for (std::size_t k = 0; k < kCount; ++k) {
      const float* first = &features[k * row];
      const bool none = std::isnan(first[rcirl::detail::kTime]);  // never NaN by itself
      unknown += none;
      for (std::size_t t = 0; t < rcirl::kTimes && !none && bits.folded; ++t) {
        check_row(first + t * columns.size());
      }
    }
    require(unknown == refused);
    check_rulings(made, {s.data(), offsets, kCount}, status.ok());
    require(status.ok() ? !bits.folded || refused == 0 : refused == kCount);
  }
  return 0;
}
