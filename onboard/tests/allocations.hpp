// Counts every allocation of a test program, whichever form of `new` asks for it.
//
// Replaces the global operators: include it in one file of a program.
#ifndef RCIRL_TESTS_ALLOCATIONS_HPP_
#define RCIRL_TESTS_ALLOCATIONS_HPP_

#include <atomic>
#include <cstdlib>
#include <new>

static std::atomic<long> allocations{0};

static void* counted(std::size_t size, std::size_t alignment) {
  ++allocations;
  void* memory = std::aligned_alloc(alignment, (size + alignment - 1) / alignment * alignment);
  if (memory == nullptr) std::abort();
  return memory;
}

void* operator new(std::size_t size) { return counted(size, 16); }
void* operator new(std::size_t size, std::align_val_t alignment) {
  return counted(size, static_cast<std::size_t>(alignment));
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }
void operator delete(void* memory, std::align_val_t) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t, std::align_val_t) noexcept { std::free(memory); }

#endif  // RCIRL_TESTS_ALLOCATIONS_HPP_
