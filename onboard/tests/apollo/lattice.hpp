// A stand-in for the types of Apollo's lattice planner that adapters/apollo reads: the same
// names, as far as they are used, and nothing else.
#ifndef RCIRL_TESTS_APOLLO_LATTICE_HPP_
#define RCIRL_TESTS_APOLLO_LATTICE_HPP_

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

namespace apollo::common {

struct PathPoint {
  double x_ = 0.0, y_ = 0.0, theta_ = 0.0, kappa_ = 0.0, s_ = 0.0;

  double x() const { return x_; }
  double y() const { return y_; }
  double theta() const { return theta_; }
  double kappa() const { return kappa_; }
  double s() const { return s_; }
};

struct TrajectoryPoint {
  PathPoint path_point_;
  double v_ = 0.0, a_ = 0.0;

  const PathPoint& path_point() const { return path_point_; }
  double v() const { return v_; }
  double a() const { return a_; }
};

struct VehicleParam {
  double length_ = 4.933, width_ = 2.11;

  double front_edge_to_center() const { return 3.89; }
  double back_edge_to_center() const { return 1.043; }
  double length() const { return length_; }
  double width() const { return width_; }
};

}  // namespace apollo::common

namespace apollo::perception {

struct PerceptionObstacle {
  enum Type { UNKNOWN, UNKNOWN_MOVABLE, UNKNOWN_UNMOVABLE, PEDESTRIAN, BICYCLE, VEHICLE };
  std::int32_t id_ = 0;
  Type type_ = VEHICLE;

  std::int32_t id() const { return id_; }
  Type type() const { return type_; }
};

}  // namespace apollo::perception

namespace apollo::planning {

struct Box2d {
  double x_ = 0.0, y_ = 0.0, heading_ = 0.0, length_ = 4.5, width_ = 1.8;

  double center_x() const { return x_; }
  double center_y() const { return y_; }
  double heading() const { return heading_; }
  double length() const { return length_; }
  double width() const { return width_; }
};

struct Obstacle {
  perception::PerceptionObstacle perception_;
  Box2d box_;
  double speed_ = 0.0;
  bool is_virtual_ = false;

  const perception::PerceptionObstacle& Perception() const { return perception_; }
  const Box2d& PerceptionBoundingBox() const { return box_; }
  double speed() const { return speed_; }
  bool IsVirtual() const { return is_virtual_; }
};

struct ReferenceLine {
  double limit = 50.0 / 3.6;

  double GetSpeedLimitFromS(double) const { return limit; }
  bool GetLaneWidth(double, double* left, double* right) const {
    *left = 1.75, *right = 1.75;
    return true;
  }
};

struct StopPoint {
  double s_ = 0.0;
  double s() const { return s_; }
};

struct PlanningTarget {
  bool has_stop_point_ = false;
  StopPoint stop_point_;

  bool has_stop_point() const { return has_stop_point_; }
  const StopPoint& stop_point() const { return stop_point_; }
};

class Curve1d {
 public:
  virtual ~Curve1d() = default;
  virtual double Evaluate(const std::uint32_t order, const double param) const = 0;
};

// Pairs with costs, the cheapest first.
class TrajectoryEvaluator {
 public:
  using Trajectory1dPair = std::pair<std::shared_ptr<Curve1d>, std::shared_ptr<Curve1d>>;

  explicit TrajectoryEvaluator(std::vector<std::pair<Trajectory1dPair, double>> pairs)
      : pairs_(std::move(pairs)) {
    std::stable_sort(pairs_.begin(), pairs_.end(),
                     [](const auto& a, const auto& b) { return a.second > b.second; });
  }

  bool has_more_trajectory_pairs() const { return !pairs_.empty(); }
  std::size_t num_of_trajectory_pairs() const { return pairs_.size(); }
  Trajectory1dPair next_top_trajectory_pair() {
    const Trajectory1dPair top = pairs_.back().first;
    pairs_.pop_back();
    return top;
  }
  double top_trajectory_pair_cost() const { return pairs_.back().second; }

 private:
  std::vector<std::pair<Trajectory1dPair, double>> pairs_;
};

}  // namespace apollo::planning

#endif  // RCIRL_TESTS_APOLLO_LATTICE_HPP_
