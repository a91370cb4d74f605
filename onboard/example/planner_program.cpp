// A planner as a program: IDM behind the nearest body in the ego's corridor.
//
//   c++ -std=c++17 -O2 -o planner_program onboard/example/planner_program.cpp
//   rcirl simulate --planner=./planner_program --output=DIR
//
// Lines of JSON come in and go out (docs/own_process.md). `Reader` reads what the
// protocol sends and no more: texts without escapes.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <limits>
#include <string>
#include <vector>

struct Body {
  bool valid = false;  // of all these the first of 18 times
  double s_lower = 0, s_upper = 0, l_lower = 0, l_upper = 0, speed = 0;
};

struct Scene {
  double s = 0, l = 0, v = 0, length = 0, width = 0;  // of the ego
  std::vector<double> speed_limit;                    // m/s, a station each
  std::vector<Body> obstacles;
};

class Reader {
 public:
  explicit Reader(const std::string& line) : at_(line.c_str()) {}

  template <class Each>  // each(key) reads the value
  void object(Each each) {
    for (expect('{'); !ends('}');) {
      const std::string key = text();
      expect(':');
      each(key);
    }
  }

  template <class Each>
  void list(Each each) {
    for (expect('['); !ends(']');) each();
  }

  double number() {  // null, true and false too
    skip();
    if (*at_ == 'n') return word(4), std::numeric_limits<double>::quiet_NaN();
    if (*at_ == 't') return word(4), 1.0;
    if (*at_ == 'f') return word(5), 0.0;
    char* end = nullptr;
    const double value = std::strtod(at_, &end);
    if (end == at_) fail();
    at_ = end;
    return value;
  }

  std::vector<double> numbers() {
    std::vector<double> values;
    list([&] { values.push_back(number()); });
    return values;
  }

  double first() {
    const std::vector<double> values = numbers();
    return values.empty() ? 0.0 : values[0];
  }

  void any() {  // reads over a value
    skip();
    if (*at_ == '"') text();
    else if (*at_ == '{') object([&](const std::string&) { any(); });
    else if (*at_ == '[') list([&] { any(); });
    else number();
  }

  std::string text() {
    expect('"');
    const char* begin = at_;
    while (*at_ != '"') {
      if (*at_ == '\0' || *at_ == '\\') fail();
      ++at_;
    }
    return std::string(begin, at_++);
  }

 private:
  void skip() {
    while (*at_ == ' ' || *at_ == ',') ++at_;
  }
  void expect(char c) {
    skip();
    if (*at_ != c) fail();
    ++at_;
  }
  bool ends(char c) {
    skip();
    if (*at_ == '\0') fail();
    return *at_ == c ? ++at_, true : false;
  }
  void word(int size) {
    for (int i = 0; i < size; ++i, ++at_)
      if (*at_ == '\0') fail();
  }
  [[noreturn]] void fail() {
    std::fprintf(stderr, "not of the protocol: %.40s\n", at_);
    std::exit(2);
  }

  const char* at_;
};

Body read_body(Reader& in) {
  Body body;
  in.object([&](const std::string& key) {
    if (key == "valid") body.valid = in.first() > 0.5;
    else if (key == "s_lower") body.s_lower = in.first();
    else if (key == "s_upper") body.s_upper = in.first();
    else if (key == "l_lower") body.l_lower = in.first();
    else if (key == "l_upper") body.l_upper = in.first();
    else if (key == "speed") body.speed = in.first();
    else in.any();
  });
  return body;
}

Scene read_scene(Reader& in) {
  Scene scene;
  in.object([&](const std::string& part) {
    if (part == "ego") {
      in.object([&](const std::string& key) {
        const double value = in.number();
        if (key == "s") scene.s = value;
        if (key == "l") scene.l = value;
        if (key == "v") scene.v = value;
        if (key == "length") scene.length = value;
        if (key == "width") scene.width = value;
      });
    } else if (part == "path") {
      in.object([&](const std::string& key) {
        if (key == "speed_limit") scene.speed_limit = in.numbers();
        else in.any();
      });
    } else if (part == "obstacles") {
      in.list([&] { scene.obstacles.push_back(read_body(in)); });
    } else {
      in.any();
    }
  });
  return scene;
}

double acceleration(const Scene& scene) {
  const double front = scene.s + 0.5 * scene.length, v = scene.v;
  double gap = std::numeric_limits<double>::infinity(), closing = 0.0;
  for (const Body& body : scene.obstacles) {
    const double aside = std::max(body.l_lower - scene.l, scene.l - body.l_upper);
    const bool leads = body.valid && aside < 0.5 * scene.width + 0.2 && body.s_upper > scene.s;
    if (!leads || body.s_lower - front >= gap) continue;
    gap = body.s_lower - front;
    closing = v - body.speed;
  }
  if (std::isinf(gap)) gap = 1000.0;
  const double wanted = 2.0 + std::max(1.5 * v + v * closing / (2.0 * std::sqrt(1.4 * 2.0)), 0.0);
  const double limit = scene.speed_limit.empty() ? 0.0 : scene.speed_limit[0];
  const double free = std::pow(v / std::max(limit, 0.1), 4.0);
  const double a = 1.4 * (1.0 - free - std::pow(wanted / std::max(gap, 0.1), 2.0));
  return std::clamp(a, -8.0, 1.4);
}

void print(const char* name, const std::vector<double>& values, const char* end) {
  std::printf("\"%s\":[", name);
  for (std::size_t i = 0; i < values.size(); ++i) std::printf("%s%.9g", i ? "," : "", values[i]);
  std::printf("]%s", end);
}

int main() {
  std::string line;
  std::vector<double> times;
  if (!std::getline(std::cin, line)) return 2;
  Reader hello(line);
  hello.object([&](const std::string& key) {
    if (key == "times") times = hello.numbers();
    else hello.any();
  });
  std::printf("{\"protocol\":1,\"name\":\"IDM in C++\"}\n");
  std::fflush(stdout);
  while (std::getline(std::cin, line)) {
    Reader in(line);
    Scene scene;
    in.object([&](const std::string& key) {
      if (key == "scene") scene = read_scene(in);
      else in.any();
    });
    const double v = scene.v, a = acceleration(scene);
    std::vector<double> s, speeds;
    for (const double t : times) {
      const double until = a < 0.0 ? std::min(t, v / -std::min(a, -1e-6)) : t;
      s.push_back(v * until + 0.5 * a * until * until);
      speeds.push_back(v + a * until);
    }
    std::printf("{");
    print("s", s, ",");
    print("v", speeds, ",");
    print("a", std::vector<double>(times.size(), a), "}\n");
    std::fflush(stdout);
  }
  return 0;
}
