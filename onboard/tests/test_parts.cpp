// SHA-256, tanh and UTF-8 against what is known of them.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string>

#include "check.hpp"
#include "rcirl/detail/network.hpp"
#include "rcirl/detail/sha256.hpp"
#include "rcirl/detail/tree.hpp"

namespace {

std::string hash(const std::string& text) {
  return rcirl::detail::sha256_hex(text.data(), text.size());
}

// Examples of FIPS 180-4, and lengths on both sides of the padding's edges.
void test_sha256() {
  CHECK_TEXT(hash(""), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
  CHECK_TEXT(hash("abc"), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
  CHECK_TEXT(hash("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq"),
             "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
  CHECK_TEXT(hash(std::string(1000000, 'a')),
             "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
  CHECK_TEXT(hash(std::string(55, 'a')),
             "9f4390f8d30c2dd92ec9f095b65e2b9ae9b0a925a5258e241c9f1e910f734318");
  CHECK_TEXT(hash(std::string(64, 'a')),
             "ffe054fe7ae0cb6dc65c3af9b61d5209f439851db43d0ba5997337df154668eb");
}

float tanh_of(float x) {
  rcirl::detail::Lanes lanes;
  for (float& lane : lanes.at) lane = x;
  rcirl::detail::tanh_lanes(lanes.at);
  return lanes.at[7];
}

// Every `kStep`-th float32 of either sign, infinities included.
void test_tanh() {
  constexpr std::uint32_t kStep = 1009, kInfinity = 0x7f800000;
  double worst = 0.0;
  for (std::uint32_t bits = 0; bits <= kInfinity; bits += kStep) {
    float x;
    std::memcpy(&x, &bits, sizeof x);
    const double exact = std::tanh(static_cast<double>(x));
    const double error = std::abs(static_cast<double>(tanh_of(x)) - exact);
    worst = std::max(worst, exact > 0.0 ? error / exact : error);
    CHECK(tanh_of(-x) == -tanh_of(x));
  }
  CHECK(worst <= 4e-7);
  const float infinity = std::numeric_limits<float>::infinity();
  CHECK(std::abs(tanh_of(infinity) - 1.0f) <= 4e-7f);
  CHECK(std::isnan(tanh_of(std::numeric_limits<float>::quiet_NaN())));
}

void test_utf8() {
  using rcirl::detail::utf8_length;
  CHECK(utf8_length("") == 0);
  CHECK(utf8_length("m/s\xc2\xb2") == 4);
  CHECK(utf8_length("\xe2\x82\xac\xf0\x9f\x9a\x97") == 2);
  CHECK(utf8_length("\xf4\x8f\xbf\xbf\xed\x9f\xbf\xee\x80\x80") == 3);
  for (const char* wrong :
       {"\x80", "\xc0\xaf", "\xc1\xbf", "\xe0\x9f\xbf", "\xed\xa0\x80", "\xf0\x8f\xbf\xbf",
        "\xf4\x90\x80\x80", "\xf5\x80\x80\x80", "\xff", "\xc2", "\xe2\x82", "\xe2\x28\xa1"}) {
    CHECK(utf8_length(wrong) == -1);
  }
}

}  // namespace

int main() {
  test_sha256();
  test_tanh();
  test_utf8();
  return failures == 0 ? 0 : 1;
}
