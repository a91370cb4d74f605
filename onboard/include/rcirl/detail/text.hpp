// Numbers as float32, and as texts; places and lines of messages.
#ifndef RCIRL_DETAIL_TEXT_HPP_
#define RCIRL_DETAIL_TEXT_HPP_

#include <cmath>
#include <cstddef>
#include <cstdio>
#include <limits>
#include <string>
#include <string_view>

namespace rcirl::detail {

// A double as float32; what lies beyond becomes infinite, as numpy makes it.
inline float narrow(double value) {
  constexpr float kMost = std::numeric_limits<float>::max();
  constexpr float kInfinity = std::numeric_limits<float>::infinity();
  if (std::abs(value) <= static_cast<double>(kMost)) return static_cast<float>(value);
  return value > 0.0 ? kInfinity : -kInfinity;
}

inline std::string number_text(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.9g", value);
  return text;
}

inline std::string index_text(std::string_view field, std::size_t index) {
  return std::string(field) + "[" + std::to_string(index) + "]";
}

// At most 96 bytes, cut between characters.
inline std::string shortened(std::string_view text) {
  if (text.size() <= 96) return std::string(text);
  std::size_t end = 93;
  while (end > 0 && (static_cast<unsigned char>(text[end]) & 0xc0) == 0x80) --end;
  return std::string(text.substr(0, end)) + "...";
}

// One line for a terminal: control characters (ASCII, and U+0080 to U+009F) become '?'.
inline std::string one_line(std::string_view text) {
  std::string line;
  for (std::size_t i = 0; i < text.size(); ++i) {
    const auto byte = static_cast<unsigned char>(text[i]);
    const bool second = byte == 0xc2 && i + 1 < text.size();
    const bool control = second && static_cast<unsigned char>(text[i + 1]) < 0xa0;
    if (control) ++i;
    line += byte < 0x20 || byte == 0x7f || control ? '?' : text[i];
  }
  return line;
}

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_TEXT_HPP_
