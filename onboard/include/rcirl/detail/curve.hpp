// A smoothed reference line and the way of points along it; see
// `rcirl_jax/geometry/frenet.py`.
#ifndef RCIRL_DETAIL_CURVE_HPP_
#define RCIRL_DETAIL_CURVE_HPP_

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

namespace rcirl::detail {

constexpr double kLineStepM = 2.0;    // m between grid points of a line
constexpr double kSmoothing = 30.0;   // penalty of the spline on second derivatives
constexpr double kSamePlaceM = 1e-3;  // m, a step of a polyline that is none
constexpr int kNewtonSteps = 6;       // after the nearest grid point
using XY = std::array<double, 2>;     // m

// Values between rising places `at`, held at both ends.
inline double interpolated(const std::vector<double>& at, const std::vector<double>& values,
                           double x) {
  if (x <= at.front()) return values.front();
  if (x >= at.back()) return values.back();
  const auto next = std::upper_bound(at.begin(), at.end(), x);
  const auto i = static_cast<std::size_t>(next - at.begin()) - 1;
  return values[i] + (x - at[i]) / (at[i + 1] - at[i]) * (values[i + 1] - values[i]);
}

// A cubic smoothing spline on an even grid: least sum (y - g)^2 + lambda integral g''^2.
// Source: Reinsch 1967; (R + lambda Q'Q) c = Q'y, g = y - lambda Q c, c the second
// derivatives. Its values and derivatives are those of scipy's `make_smoothing_spline`.
class Spline {
 public:
  Spline(const std::vector<double>& y, double step) : step_(step), g_(y), c_(y.size(), 0.0) {
    const std::size_t m = y.size() - 2;
    const double h2 = step * step, a = 2.0 * step / 3.0 + kSmoothing * 6.0 / h2;
    const double b = step / 6.0 - kSmoothing * 4.0 / h2, e = kSmoothing / h2;
    std::vector<double> d(m), p(m), q(m), z(m);  // L D L', its bands p and q
    for (std::size_t i = 0; i < m; ++i) {
      d[i] = a;
      z[i] = (y[i] - 2.0 * y[i + 1] + y[i + 2]) / step;
      double beside = b;
      if (i >= 1) {
        d[i] -= p[i - 1] * p[i - 1] * d[i - 1];
        z[i] -= p[i - 1] * z[i - 1];
        beside -= q[i - 1] * p[i - 1] * d[i - 1];
      }
      if (i >= 2) {
        d[i] -= q[i - 2] * q[i - 2] * d[i - 2];
        z[i] -= q[i - 2] * z[i - 2];
      }
      p[i] = beside / d[i];
      q[i] = e / d[i];
    }
    for (std::size_t i = m; i-- > 0;) {
      c_[i + 1] = z[i] / d[i];
      if (i + 1 < m) c_[i + 1] -= p[i] * c_[i + 2];
      if (i + 2 < m) c_[i + 1] -= q[i] * c_[i + 3];
    }
    for (std::size_t i = 0; i < y.size(); ++i) {
      double bend = -2.0 * c_[i];
      if (i > 0) bend += c_[i - 1];
      if (i + 1 < y.size()) bend += c_[i + 1];
      g_[i] -= kSmoothing * bend / step;
    }
  }

  // Value, first and second derivative at u.
  std::array<double, 3> at(double u) const {
    const double place = std::max(u / step_, 0.0);
    const std::size_t i = std::min(static_cast<std::size_t>(place), g_.size() - 2);
    const double t = place - static_cast<double>(i), r = 1.0 - t;
    const double low = c_[i], high = c_[i + 1], sixth = step_ / 6.0;
    return {r * g_[i] + t * g_[i + 1] +
                sixth * step_ * ((r * r * r - r) * low + (t * t * t - t) * high),
            (g_[i + 1] - g_[i]) / step_ +
                sixth * ((3.0 * t * t - 1.0) * high - (3.0 * r * r - 1.0) * low),
            r * low + t * high};
  }

 private:
  double step_;
  std::vector<double> g_, c_;  // values, second derivatives
};

// A line on an even grid of stations, straight beyond its end.
class Line {
 public:
  // Of a polyline at least 1 m long.
  explicit Line(const std::vector<XY>& points) {
    std::vector<double> arc = {0.0}, xs = {points[0][0]}, ys = {points[0][1]};
    for (std::size_t i = 1; i < points.size(); ++i) {
      const double step =
          std::hypot(points[i][0] - points[i - 1][0], points[i][1] - points[i - 1][1]);
      length_ += step;
      if (step <= kSamePlaceM) continue;
      xs.push_back(points[i][0]);
      ys.push_back(points[i][1]);
      arc.push_back(arc.back() + std::hypot(xs.back() - xs[xs.size() - 2],
                                            ys.back() - ys[ys.size() - 2]));
    }
    const auto dense = std::max(static_cast<std::size_t>(arc.back()) + 1, std::size_t{5});
    const double step = arc.back() / static_cast<double>(dense - 1);
    std::vector<double> thin_x(dense), thin_y(dense);
    for (std::size_t i = 0; i < dense; ++i) {
      thin_x[i] = interpolated(arc, xs, static_cast<double>(i) * step);
      thin_y[i] = interpolated(arc, ys, static_cast<double>(i) * step);
    }
    sample(Spline(thin_x, step), Spline(thin_y, step), arc.back(), 8 * dense);
  }

  double length() const { return length_; }  // m, of the polyline

  double heading(double s) const { return interpolated(grid_, heading_, s); }
  double kappa(double s) const { return s > grid_.back() ? 0.0 : interpolated(grid_, kappa_, s); }

  // (s, l) of a point: from the nearest grid point, Newton on t(s) . (p - r(s)).
  XY project(const XY& point) const {
    std::size_t nearest = 0;
    const auto apart = [&](std::size_t i) {
      return std::hypot(x_[i] - point[0], y_[i] - point[1]);
    };
    for (std::size_t i = 1; i < x_.size(); ++i) {
      if (apart(i) < apart(nearest)) nearest = i;
    }
    double s = grid_[nearest];
    for (int i = 0; i < kNewtonSteps; ++i) {
      const XY off = offset(s, point);
      s += off[0] / std::max(1.0 - interpolated(grid_, kappa_, s) * off[1], 0.2);
    }
    return {s, offset(s, point)[1]};
  }

 private:
  void sample(const Spline& x, const Spline& y, double end, std::size_t fine) {
    std::vector<double> u(fine), length(fine, 0.0);
    const double step = end / static_cast<double>(fine - 1);
    for (std::size_t i = 0; i < fine; ++i) u[i] = static_cast<double>(i) * step;
    for (std::size_t i = 1; i < fine; ++i) {
      length[i] = length[i - 1] + std::hypot(x.at(u[i])[0] - x.at(u[i - 1])[0],
                                             y.at(u[i])[0] - y.at(u[i - 1])[0]);
    }
    const auto size = static_cast<std::size_t>(length_ / kLineStepM) + 2;
    for (std::size_t p = 0; p < size; ++p) {
      grid_.push_back(kLineStepM * static_cast<double>(p));
      const double beyond = std::max(grid_[p] - length.back(), 0.0);
      const double at = interpolated(length, u, grid_[p]);
      const auto [px, dx, ddx] = x.at(at);
      const auto [py, dy, ddy] = y.at(at);
      double angle = std::atan2(dy, dx);
      if (p > 0) angle = heading_.back() + std::remainder(angle - heading_.back(), 2.0 * kPi);
      const double speed = std::max(std::hypot(dx, dy), 1e-9);
      heading_.push_back(angle);
      kappa_.push_back(beyond > 0.0 ? 0.0 : (dx * ddy - dy * ddx) / (speed * speed * speed));
      x_.push_back(px + beyond * std::cos(angle));
      y_.push_back(py + beyond * std::sin(angle));
    }
  }

  // How far a point lies along and across (left) of the line at s: a cubic Hermite curve
  // through the grid points.
  XY offset(double s, const XY& point) const {
    const double place = s / kLineStepM, last = static_cast<double>(x_.size() - 2);
    const double low = std::clamp(std::floor(place), 0.0, last);
    const double u = std::clamp(place - low, 0.0, 1.0);
    const auto i = static_cast<std::size_t>(low);
    const double a = heading_[i], b = heading_[i + 1], angle = a + u * (b - a);
    const double h00 = (1 + 2 * u) * (1 - u) * (1 - u), h10 = u * (1 - u) * (1 - u);
    const double h01 = u * u * (3 - 2 * u), h11 = u * u * (u - 1);
    const double beyond = (place - low - u) * kLineStepM;
    const double x = h00 * x_[i] + h01 * x_[i + 1] + beyond * std::cos(angle) +
                     kLineStepM * (h10 * std::cos(a) + h11 * std::cos(b));
    const double y = h00 * y_[i] + h01 * y_[i + 1] + beyond * std::sin(angle) +
                     kLineStepM * (h10 * std::sin(a) + h11 * std::sin(b));
    const double dx = point[0] - x, dy = point[1] - y;
    return {dx * std::cos(angle) + dy * std::sin(angle),
            dy * std::cos(angle) - dx * std::sin(angle)};
  }

  static constexpr double kPi = 3.14159265358979323846;

  double length_ = 0.0;
  std::vector<double> grid_, x_, y_, heading_, kappa_;
};

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_CURVE_HPP_
