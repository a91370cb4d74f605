// msgpack bytes -> a tree of nodes that point into those bytes.
//
// The decoding is msgpack-c's own C template, `msgpack/unpack_template.h` (Debian
// libmsgpack-dev): headers only, no exceptions, no allocation, nesting bounded. The
// call-backs below allocate one node for each object that has really arrived, so a
// length that a file only claims costs nothing.
#ifndef RCIRL_DETAIL_TREE_HPP_
#define RCIRL_DETAIL_TREE_HPP_

#include <assert.h>  // the C headers that msgpack-c's own will ask for
#include <msgpack/sysdep.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "rcirl/detail/limits.hpp"

namespace rcirl::detail {

enum class Kind : std::uint8_t { kNil, kBool, kInt, kUint, kFloat, kText, kBytes, kList, kMap };

struct Node {
  Kind kind = Kind::kNil;
  bool truth = false;           // kBool
  std::int64_t integer = 0;     // kInt, below zero
  std::uint64_t natural = 0;    // kUint
  double real = 0.0;            // kFloat
  std::string_view bytes;       // kText (UTF-8), kBytes; in the caller's buffer
  std::uint32_t count = 0;      // entries of kList, kMap
  std::uint32_t first = 0;      // kList: first item; kMap: first key; 0 is none
  std::uint32_t last = 0;       // its end, while the tree grows
  std::uint32_t next = 0;       // item -> item; key -> value -> key
};

// Number of characters of UTF-8 text; -1 where it is not UTF-8 (RFC 3629).
inline std::ptrdiff_t utf8_length(std::string_view text) {
  std::ptrdiff_t count = 0;
  for (std::size_t at = 0; at < text.size(); ++count) {
    const auto byte = [&](std::size_t i) { return static_cast<unsigned char>(text[i]); };
    const unsigned lead = byte(at);
    const std::size_t size = lead < 0x80 ? 1 : lead < 0xe0 ? 2 : lead < 0xf0 ? 3 : 4;
    if ((lead >= 0x80 && lead < 0xc2) || lead > 0xf4 || size > text.size() - at) return -1;
    for (std::size_t i = 1; i < size; ++i) {
      unsigned low = 0x80, high = 0xbf;
      if (i == 1) {  // no overlong forms, no surrogates, nothing above U+10FFFF
        low = lead == 0xe0 ? 0xa0 : lead == 0xf0 ? 0x90 : low;
        high = lead == 0xed ? 0x9f : lead == 0xf4 ? 0x8f : high;
      }
      if (byte(at + i) < low || byte(at + i) > high) return -1;
    }
    at += size;
  }
  return count;
}

struct Tree {
  std::vector<Node> nodes = std::vector<Node>(1);  // node 0 is "none"
  std::uint32_t root = 0;
  std::uint32_t entries = 0;      // of all lists and maps
  const char* refused = nullptr;  // why a call-back stopped the decoding

  const Node& at(std::uint32_t index) const { return nodes[index]; }

  int fail(const char* reason) {
    refused = reason;
    return -1;
  }

  int add(Node node, std::uint32_t* index) {
    *index = static_cast<std::uint32_t>(nodes.size());
    nodes.push_back(node);
    return 0;
  }

  int add_natural(std::uint64_t value, std::uint32_t* index) {
    Node node;
    node.kind = Kind::kUint;
    node.natural = value;
    return add(node, index);
  }

  int add_integer(std::int64_t value, std::uint32_t* index) {
    if (value >= 0) return add_natural(static_cast<std::uint64_t>(value), index);
    Node node;
    node.kind = Kind::kInt;
    node.integer = value;
    return add(node, index);
  }

  int add_real(double value, std::uint32_t* index) {
    Node node;
    node.kind = Kind::kFloat;
    node.real = value;
    return add(node, index);
  }

  int add_truth(bool value, std::uint32_t* index) {
    Node node;
    node.kind = Kind::kBool;
    node.truth = value;
    return add(node, index);
  }

  int add_bytes(Kind kind, const char* data, unsigned size, std::uint32_t* index) {
    Node node;
    node.kind = kind;
    if (size > 0) node.bytes = {data, size};
    if (kind == Kind::kText && size > kMaxText) return fail("a text over 65536 bytes");
    if (kind == Kind::kText && utf8_length(node.bytes) < 0) return fail("a text not UTF-8");
    return add(node, index);
  }

  int add_container(Kind kind, std::uint32_t count, std::uint32_t* index) {
    if (count > kMaxItems) return fail("a list or map over 4096 entries");
    entries += 1 + count;
    if (entries > kMaxNodes) return fail("over 65536 entries");
    Node node;
    node.kind = kind;
    node.count = count;
    return add(node, index);
  }

  int append(std::uint32_t container, std::uint32_t item) {
    Node& node = nodes[container];
    (node.last == 0 ? node.first : nodes[node.last].next) = item;
    node.last = item;
    return 0;
  }

  int append_pair(std::uint32_t container, std::uint32_t key, std::uint32_t value) {
    if (at(key).kind != Kind::kText) return fail("a key that is no text");
    append(container, key);
    return append(container, value);
  }

  bool keys_are_unique() const {
    std::vector<std::string_view> keys;
    for (const Node& node : nodes) {
      if (node.kind != Kind::kMap) continue;
      keys.clear();
      for (std::uint32_t key = node.first; key != 0; key = at(at(key).next).next) {
        keys.push_back(at(key).bytes);
      }
      std::sort(keys.begin(), keys.end());
      if (std::adjacent_find(keys.begin(), keys.end()) != keys.end()) return false;
    }
    return true;
  }
};

using UnpackUser = Tree*;
using UnpackObject = std::uint32_t;

inline std::uint32_t unpack_root(UnpackUser*) { return 0; }
inline int unpack_nil(UnpackUser* u, UnpackObject* o) { return (*u)->add(Node{}, o); }
inline int unpack_true(UnpackUser* u, UnpackObject* o) { return (*u)->add_truth(true, o); }
inline int unpack_false(UnpackUser* u, UnpackObject* o) { return (*u)->add_truth(false, o); }
inline int unpack_uint8(UnpackUser* u, std::uint8_t v, UnpackObject* o) {
  return (*u)->add_natural(v, o);
}
inline int unpack_uint16(UnpackUser* u, std::uint16_t v, UnpackObject* o) {
  return (*u)->add_natural(v, o);
}
inline int unpack_uint32(UnpackUser* u, std::uint32_t v, UnpackObject* o) {
  return (*u)->add_natural(v, o);
}
inline int unpack_uint64(UnpackUser* u, std::uint64_t v, UnpackObject* o) {
  return (*u)->add_natural(v, o);
}
inline int unpack_int8(UnpackUser* u, std::int8_t v, UnpackObject* o) {
  return (*u)->add_integer(v, o);
}
inline int unpack_int16(UnpackUser* u, std::int16_t v, UnpackObject* o) {
  return (*u)->add_integer(v, o);
}
inline int unpack_int32(UnpackUser* u, std::int32_t v, UnpackObject* o) {
  return (*u)->add_integer(v, o);
}
inline int unpack_int64(UnpackUser* u, std::int64_t v, UnpackObject* o) {
  return (*u)->add_integer(v, o);
}
inline int unpack_float(UnpackUser* u, float v, UnpackObject* o) {
  return (*u)->add_real(v, o);
}
inline int unpack_double(UnpackUser* u, double v, UnpackObject* o) {
  return (*u)->add_real(v, o);
}
inline int unpack_str(UnpackUser* u, const char*, const char* p, unsigned n, UnpackObject* o) {
  return (*u)->add_bytes(Kind::kText, p, n, o);
}
inline int unpack_bin(UnpackUser* u, const char*, const char* p, unsigned n, UnpackObject* o) {
  return (*u)->add_bytes(Kind::kBytes, p, n, o);
}
inline int unpack_ext(UnpackUser* u, const char*, const char*, unsigned, UnpackObject*) {
  return (*u)->fail("an ext type");
}
inline int unpack_array(UnpackUser* u, unsigned n, UnpackObject* o) {
  return (*u)->add_container(Kind::kList, n, o);
}
inline int unpack_map(UnpackUser* u, unsigned n, UnpackObject* o) {
  return (*u)->add_container(Kind::kMap, n, o);
}
inline int unpack_array_item(UnpackUser* u, UnpackObject* c, UnpackObject item) {
  return (*u)->append(*c, item);
}
inline int unpack_map_item(UnpackUser* u, UnpackObject* c, UnpackObject key, UnpackObject v) {
  return (*u)->append_pair(*c, key, v);
}

// Inside the namespace, so that msgpack-c's C++ headers may stand in the same file.
#ifndef MSGPACK_UNPACK_DEFINE_H
#include <msgpack/unpack_define.h>
#undef MSGPACK_UNPACK_DEFINE_H
#endif

// What the template returns for wrong bytes and for more than 32 levels.
constexpr int MSGPACK_UNPACK_PARSE_ERROR = -1;
constexpr int MSGPACK_UNPACK_NOMEM_ERROR = -1;

#define msgpack_unpack_func(result, name) inline result unpack##name
#define msgpack_unpack_callback(name) unpack##name
#define msgpack_unpack_struct(name) struct unpack##name
#define msgpack_unpack_object UnpackObject
#define msgpack_unpack_user UnpackUser
#include <msgpack/unpack_template.h>
#undef msgpack_unpack_struct_decl
#undef USE_CASE_RANGE

// One object with nothing behind it. Empty: fine; otherwise what is wrong.
inline std::string parse(std::string_view data, Tree* tree) {
  unpack_context context;
  unpack_init(&context);
  context.user = tree;
  std::size_t used = 0;
  const int result = unpack_execute(&context, data.data(), data.size(), &used);
  if (tree->refused != nullptr) return tree->refused;
  if (result < 0) return "no msgpack";
  if (result == 0) return "incomplete input";
  if (used < data.size()) return std::to_string(data.size() - used) + " bytes after it";
  if (!tree->keys_are_unique()) return "a key used twice";
  tree->root = unpack_data(&context);
  return {};
}

}  // namespace rcirl::detail

#endif  // RCIRL_DETAIL_TREE_HPP_
