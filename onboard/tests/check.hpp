// CHECK for tests that must build without exceptions.
#ifndef RCIRL_TESTS_CHECK_HPP_
#define RCIRL_TESTS_CHECK_HPP_

#include <cstdio>
#include <string>

inline int failures = 0;

inline void check(bool good, const char* file, int line, const std::string& what) {
  if (good) return;
  ++failures;
  std::fprintf(stderr, "%s:%d: %s\n", file, line, what.c_str());
}

#define CHECK(condition) check((condition), __FILE__, __LINE__, #condition)
#define CHECK_TEXT(found, wanted) \
  check((found) == (wanted), __FILE__, __LINE__, "found '" + std::string(found) + "'")

#endif  // RCIRL_TESTS_CHECK_HPP_
