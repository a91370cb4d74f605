// Checks of single values; the first failure is kept as "field: value: expected ...".
#ifndef RCIRL_DETAIL_CHECKS_HPP_
#define RCIRL_DETAIL_CHECKS_HPP_

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <limits>
#include <string>
#include <string_view>
#include <vector>

#include "rcirl/detail/limits.hpp"
#include "rcirl/detail/text.hpp"
#include "rcirl/detail/tree.hpp"

namespace rcirl::detail {

// What stands at a node; never the inside of a list, map or bytes.
inline std::string show(const Node& node) {
  switch (node.kind) {
    case Kind::kNil: return "None";
    case Kind::kBool: return node.truth ? "True" : "False";
    case Kind::kInt: return std::to_string(node.integer);
    case Kind::kUint: return std::to_string(node.natural);
    case Kind::kFloat: return number_text(node.real);
    case Kind::kText: return shortened(node.bytes);
    case Kind::kBytes: return "bytes of " + std::to_string(node.bytes.size());
    case Kind::kList: return "list of " + std::to_string(node.count);
    case Kind::kMap: return "dict of " + std::to_string(node.count);
  }
  return {};
}

struct Range {  // of an axis length, both ends included
  std::uint64_t low, high;
  Range(std::uint64_t only) : low(only), high(only) {}  // NOLINT: an axis is a number
  Range(std::uint64_t first, std::uint64_t last) : low(first), high(last) {}
};

struct Array {
  std::vector<std::size_t> shape;
  std::vector<float> values;  // C order

  // "[i, j]" of the flat index.
  std::string place(std::size_t flat) const {
    std::string text;
    for (std::size_t axis = shape.size(); axis-- > 0; flat /= shape[axis]) {
      text = std::to_string(flat % shape[axis]) + (text.empty() ? "" : ", ") + text;
    }
    return "[" + text + "]";
  }
};

using Keys = std::vector<std::string_view>;

// Every check returns whether all went well so far, so that `&&` chains them.
class Checks {
 public:
  explicit Checks(const Tree& tree) : tree_(tree) {}

  const std::string& error() const { return error_; }

  bool fail(std::string_view field, std::string_view value, std::string_view expected) {
    if (error_.empty()) {
      error_ = std::string(field) + ": " + std::string(value) + ": expected ";
      error_ += expected;
    }
    return false;
  }

  bool fail(std::string_view field, const Node& value, std::string_view expected) {
    return fail(field, show(value), expected);
  }

  // Value of a key of a map; null where there is none.
  const Node* find(const Node& map, std::string_view wanted) const {
    if (map.kind != Kind::kMap) return nullptr;
    for (std::uint32_t key = map.first; key != 0;) {
      const Node& value = tree_.at(tree_.at(key).next);
      if (tree_.at(key).bytes == wanted) return &value;
      key = value.next;
    }
    return nullptr;
  }

  // A map with exactly these keys; their values, in this order.
  bool map(const std::string& field, const Node& node, const Keys& keys,
           std::vector<const Node*>* values) {
    if (node.kind != Kind::kMap) return fail(field, node, "a map");
    std::string listed = "the keys ";
    for (const std::string_view key : keys) {
      if (listed.size() > 9) listed += ", ";
      listed += key;
    }
    values->clear();
    for (const std::string_view key : keys) {
      values->push_back(find(node, key));
      if (values->back() == nullptr) {
        return fail(field + "." + std::string(key), "missing", listed);
      }
    }
    for (std::uint32_t at = node.first; at != 0; at = tree_.at(tree_.at(at).next).next) {
      const std::string_view key = tree_.at(at).bytes;
      bool known = false;
      for (const std::string_view wanted : keys) known |= key == wanted;
      if (!known) return fail(field + "." + shortened(key), "unknown", listed);
    }
    return true;
  }

  bool list(const std::string& field, const Node& node, std::uint32_t most,
            std::vector<const Node*>* items) {
    if (node.kind != Kind::kList || node.count < 1 || node.count > most) {
      return fail(field, node, "a list of 1 to " + std::to_string(most));
    }
    *items = children(node);
    return true;
  }

  bool text(const std::string& field, const Node& node, std::string* value) {
    const std::ptrdiff_t size = node.kind == Kind::kText ? utf8_length(node.bytes) : 0;
    if (size < 1 || size > static_cast<std::ptrdiff_t>(kMaxName)) {
      return fail(field, node, "a text of 1 to " + std::to_string(kMaxName) + " characters");
    }
    value->assign(node.bytes);
    return true;
  }

  bool number(const std::string& field, const Node& node, double* value,
              const char* expected = "a finite number") {
    if (node.kind == Kind::kUint) {
      *value = static_cast<double>(node.natural);
    } else if (node.kind == Kind::kInt) {
      *value = static_cast<double>(node.integer);
    } else if (node.kind == Kind::kFloat && std::isfinite(node.real)) {
      *value = node.real;
    } else {
      return fail(field, node, expected);
    }
    return true;
  }

  // A finite float32 array; nothing is allocated before its length is checked.
  bool array(const std::string& field, const Node& node, const std::vector<Range>& shape,
             Array* result) {
    std::vector<const Node*> parts;
    if (!map(field, node, {"shape", "dtype", "data"}, &parts)) return false;
    const Node &axes = *parts[0], &dtype = *parts[1], &data = *parts[2];
    if (dtype.kind != Kind::kText || dtype.bytes != "<f4") {
      return fail(field + ".dtype", dtype, "<f4");
    }
    std::size_t size = 1;
    if (!axis_lengths(field + ".shape", axes, shape, &result->shape, &size)) return false;
    if (data.kind != Kind::kBytes || data.bytes.size() != 4 * size) {
      return fail(field + ".data", data, std::to_string(4 * size) + " bytes");
    }
    result->values.resize(size);
    for (std::size_t i = 0; i < size; ++i) result->values[i] = little_float(&data.bytes[4 * i]);
    return every(field, *result, "finite numbers",
                 [](float value, std::size_t) { return std::isfinite(value); });
  }

  template <typename Predicate>  // (value, flat index) -> good
  bool every(const std::string& field, const Array& array, const char* expected,
             Predicate good) {
    for (std::size_t i = 0; i < array.values.size(); ++i) {
      const float value = array.values[i];
      if (!good(value, i)) {
        return fail(field + array.place(i), number_text(static_cast<double>(value)), expected);
      }
    }
    return true;
  }

  // A map of what JSON can say: texts, finite numbers, bool, nil, lists, maps.
  bool plain(const std::string& field, const Node& node, int depth) {
    if (depth == kMaxDepth && node.kind != Kind::kMap) return fail(field, node, "a map");
    const bool is_map = node.kind == Kind::kMap;
    if (depth > 0 && (is_map || node.kind == Kind::kList)) {
      const std::vector<const Node*> items = children(node);
      for (std::size_t i = is_map ? 1 : 0; i < items.size(); i += is_map ? 2 : 1) {
        if (!plain(field, *items[i], depth - 1)) return false;
      }
      return true;
    }
    if (node.kind == Kind::kText || node.kind == Kind::kBool || node.kind == Kind::kNil) {
      return true;
    }
    double unused;
    return number(field, node, &unused, "texts, finite numbers, 8 levels at most");
  }

 private:
  // Items of a list; keys and values of a map, in turn.
  std::vector<const Node*> children(const Node& node) const {
    std::vector<const Node*> items;
    for (std::uint32_t at = node.first; at != 0; at = tree_.at(at).next) {
      items.push_back(&tree_.at(at));
    }
    return items;
  }

  bool axis_lengths(const std::string& field, const Node& axes, const std::vector<Range>& wanted,
                    std::vector<std::size_t>* lengths, std::size_t* size) {
    const bool is_list = axes.kind == Kind::kList && axes.count == wanted.size();
    std::string expected, found;
    bool fits = is_list;
    const std::vector<const Node*> items = is_list ? children(axes) : std::vector<const Node*>{};
    for (std::size_t i = 0; i < wanted.size(); ++i) {
      const Range range = wanted[i];
      const char* comma = i == 0 ? "" : ", ";
      expected += comma + std::to_string(range.low);
      if (range.high > range.low) expected += " to " + std::to_string(range.high);
      if (!is_list) continue;
      const Node& item = *items[i];
      found += comma + show(item);
      fits = fits && item.kind == Kind::kUint && item.natural >= range.low &&
             item.natural <= range.high;
    }
    if (!fits) return fail(field, is_list ? "[" + found + "]" : show(axes), "[" + expected + "]");
    lengths->clear();
    for (const Node* item : items) {
      lengths->push_back(static_cast<std::size_t>(item->natural));
      *size *= lengths->back();
    }
    return true;
  }

  static float little_float(const char* bytes) {
    std::uint32_t bits = 0;
    for (int i = 3; i >= 0; --i) bits = bits << 8 | static_cast<unsigned char>(bytes[i]);
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
  }

  const Tree& tree_;
  std::string error_;
};

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_CHECKS_HPP_
