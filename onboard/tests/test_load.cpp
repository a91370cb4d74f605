// What the reader takes and what it refuses, each with the line that it says.
#include <sys/stat.h>

#include <cstdio>
#include <limits>
#include <string>
#include <vector>

#include "check.hpp"
#include "files.hpp"
#include "rcirl/reward.hpp"

namespace {

std::string refusal(const std::string& data) {
  rcirl::Reward reward;
  const rcirl::Status status = rcirl::decode(data, "w", &reward);
  CHECK(reward.features().empty() != status.ok());
  CHECK(status.message().find('\n') == std::string::npos);
  CHECK(status.message().size() < 400);
  return status.ok() ? "taken" : status.message().substr(3);
}

void expect(const std::string& data, const std::string& wanted) {
  const std::string found = refusal(data);
  check(found.find(wanted) == 0, __FILE__, __LINE__, "found '" + found + "', not " + wanted);
}

void test_a_file_and_what_it_says() {
  const Example example(3, 4, {5}, "tanh", true);
  rcirl::Reward reward;
  CHECK_TEXT(rcirl::decode(example.file(), "w", &reward).message(), "");
  CHECK(reward.preset() == "test" && reward.file() == "w");
  CHECK(reward.sha256().size() == 64);
  CHECK(reward.times() == std::vector<float>({0.0f, 0.5f, 1.0f, 1.5f}));
  CHECK(reward.features().size() == 3 && reward.features()[1].name == "feature1");
  CHECK(reward.features()[1].unit == "m/s\u00b2" && reward.features()[1].none_value == 100.0);
  const std::string before = reward.sha256();
  CHECK(!rcirl::decode("wrong", "x", &reward).ok());
  CHECK(reward.sha256() == before && reward.file() == "w");
}

void test_fields() {
  const Example e;
  const double infinity = std::numeric_limits<double>::infinity();
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const auto is = [&e](const std::string& key, const std::string& bytes,
                       const std::string& wanted) { expect(e.tampered(key, bytes), wanted); };
  const std::string column = Example::column("a", "m");
  is("preset", pack::natural(5), "preset: 5: expected a text of 1 to 64");
  is("preset", pack::text(std::string(65, 'x')), "preset: xxx");
  is("preset", pack::text("\xff"), "body: a text not UTF-8: expected one whole");
  is("preset", pack::text("a\x1b\n\xc2\x85" + std::string(64, 'b')), "preset: a??");
  std::string squares;
  for (int i = 0; i < 100; ++i) squares += "\u00b2";
  is("preset", pack::text(squares), "preset: " + squares.substr(0, 92) + "...: expected");
  is("features", pack::map({}), "features: dict of 0: expected a list of 1 to 64");
  is("features", pack::list({pack::natural(1)}), "features[0]: 1: expected a map");
  is("features", pack::list(std::vector<std::string>(65, column)), "features: list of 65");
  is("features", pack::list({column, column}), "features[1].name: a: expected a name used");
  is("features", pack::list({Example::column("a", "")}), "features[0].unit: : expected a");
  is("normaliser", pack::map({}), "normaliser.lower: missing: expected the keys lower, upp");
  const auto ranges = [](float lower, float scale) {
    return pack::map({{"lower", pack::filled({3}, lower)},
                      {"upper", pack::filled({3}, 1.0f)},
                      {"location", pack::filled({3}, 0.0f)},
                      {"scale", pack::filled({3}, scale)}});
  };
  is("normaliser", ranges(1.5f, 1.0f), "normaliser.lower[0]: 1.5: expected at most upper");
  is("normaliser", ranges(0.0f, 0.0f), "normaliser.scale[0]: 0: expected over 0");
  is("normaliser", ranges(0.0f, -1.0f), "normaliser.scale[0]: -1: expected over 0");
  is("times", pack::filled({4}, 1.0f), "times[0]: 1: expected 0 s first");
  is("times", pack::filled({4}, 0.0f), "times[1]: 0: expected increasing times");
  is("times", pack::filled({257}, 1.0f), "times.shape: [257]: expected [1 to 256]");
  is("times", pack::array({0}, {}), "times.shape: [0]: expected [1 to 256]");
  is("times", pack::list({}), "times: list of 0: expected a map");
  is("gamma", pack::filled({3}, 1.0f), "gamma.shape: [3]: expected [4]");
  is("gamma", pack::filled({4, 1}, 1.0f), "gamma.shape: list of 2: expected [4]");
  is("gamma", pack::filled({4}, nan), "gamma[0]: nan: expected finite numbers");
  is("gamma", pack::filled({4}, 3e38f), "samples[");
  is("layers", pack::list({}), "layers: list of 0: expected a list of 1 to 16");
  is("layers", pack::list(std::vector<std::string>(17, pack::map({}))), "layers: list of 17");
  is("activation", pack::text("gelu"), "activation: gelu: expected one of tanh, relu, leaky");
  is("leaky_slope", pack::real(infinity), "leaky_slope: inf: expected a finite number");
  is("leaky_slope", pack::boolean(true), "leaky_slope: True: expected a finite number");
  is("loss", pack::map({{"name", pack::text("rank")}}), "loss.leaky_rate: missing");
  is("provenance", pack::list({}), "provenance: list of 0: expected a map");
  is("provenance", pack::map({{"x", pack::bytes("1")}}), "provenance: bytes of 1: expected");
  is("provenance", pack::map({{"x", pack::real(infinity)}}), "provenance: inf");
  is("samples", pack::map({}), "samples.features: missing");
  is("extra", pack::nil(), "body.extra: unknown: expected the keys preset, features");
  is("training_range", pack::filled({1, 3}, 1.0f), "training_range.shape: [1, 3]: expected");
  is("scene_gating", pack::filled({1, 3}, 1.0f), "scene_gating.shape: [1, 3]: expected [3, 3]");
  is("prior_cost", pack::map({}), "prior_cost.incumbent: missing");
}

void test_arrays() {
  const Example e;
  const auto box = [](const std::string& shape, const std::string& dtype,
                      const std::string& data) {
    return pack::map({{"shape", shape}, {"dtype", dtype}, {"data", data}});
  };
  const std::string four = pack::list({pack::natural(4)}), f4 = pack::text("<f4");
  const std::string data = pack::bytes(std::string(16, '\0'));
  const auto is = [&e](const std::string& bytes, const std::string& wanted) {
    expect(e.tampered("gamma", bytes), wanted);
  };
  is(box(pack::text("four"), f4, data), "gamma.shape: four: expected [4]");
  is(box(pack::list({pack::real(4.0)}), f4, data), "gamma.shape: [4]: expected [4]");
  is(box(pack::list({pack::natural(1ull << 63)}), f4, data), "gamma.shape: [92233720");
  is(box(four, pack::text(">f4"), data), "gamma.dtype: >f4: expected <f4");
  is(box(four, pack::nil(), data), "gamma.dtype: None: expected <f4");
  is(box(four, f4, pack::bytes("short")), "gamma.data: bytes of 5: expected 16 bytes");
  is(box(four, f4, pack::bytes(std::string(20, '\0'))), "gamma.data: bytes of 20: expected 16");
  is(box(four, f4, pack::text(std::string(16, 'x'))), "gamma.data: xxxxxxxxxxxxxxxx: exp");
  // A length of 2^62 numbers is refused by its axis, not allocated.
  const std::string huge = pack::list({pack::natural(3), pack::natural(1ull << 60)});
  const std::string layer = pack::map({{"kernel", box(huge, f4, data)}, {"bias", data}});
  expect(e.tampered("layers", pack::list({layer})),
         "layers[0].kernel.shape: [3, 1152921504606846976]: expected [3, 1 to 4096]");
}

void test_limits() {
  const Example e;
  const auto provenance = [&e](const std::string& value) {
    return refusal(e.tampered("provenance", pack::map({{"x", value}})));
  };
  const std::string zero = pack::natural(0), whole = ": expected one whole msgpack map";
  const auto zeros = [&zero](std::size_t size) {
    return pack::list(std::vector<std::string>(size, zero));
  };
  const auto nested = [](int levels) {
    std::string value = pack::nil();
    for (int i = 0; i < levels; ++i) value = pack::list({value});
    return value;
  };
  CHECK_TEXT(provenance(zeros(4096)), "taken");
  CHECK_TEXT(provenance(zeros(4097)), "body: a list or map over 4096 entries" + whole);
  CHECK_TEXT(provenance(pack::list(std::vector<std::string>(17, zeros(4000)))),
             "body: over 65536 entries" + whole);
  CHECK_TEXT(provenance(pack::text(std::string(65536, 'x'))), "taken");
  CHECK_TEXT(provenance(pack::text(std::string(65537, 'x'))),
             "body: a text over 65536 bytes" + whole);
  CHECK_TEXT(provenance("\xd4\x05" "a"), "body: an ext type" + whole);
  CHECK_TEXT(provenance(nested(7)), "taken");
  CHECK(provenance(nested(8)).find("provenance: list of 1: expected texts") == 0);
  CHECK_TEXT(provenance(nested(100)), "body: no msgpack" + whole);
}

void test_the_outer_map() {
  const Example e;
  const std::string body = pack::map(e.body()), good = e.file();
  const std::string whole = ": expected one whole msgpack map";
  const auto outer = [&body](const char* key, const std::string& value) {
    std::vector<std::pair<std::string, std::string>> fields = {
        {"magic", pack::text("RCIRLW")},
        {"schema_version", pack::natural(1)},
        {"body", pack::bytes(body)},
        {"sha256", pack::text(rcirl::detail::sha256_hex(body.data(), body.size()))}};
    for (auto& field : fields) {
      if (field.first == key) {
        field.second = value;
        return pack::map(fields);
      }
    }
    fields.push_back({key, value});
    return pack::map(fields);
  };
  CHECK_TEXT(refusal(good), "taken");
  expect("", "size: 0 bytes or more: expected 1 to 67108864 bytes");
  expect(good + '\0', "file: 1 bytes after it" + whole);
  expect("\xc1", "file: no msgpack" + whole);
  expect("\xdd\xff\xff\xff\xff", "file: a list or map over 4096 entries" + whole);
  expect("\xc6\xff\xff\xff\xff", "file: incomplete input" + whole);
  expect(std::string(5000, '\x91'), "file: no msgpack" + whole);
  expect(pack::list({}), "magic: missing or another: expected 'RCIRLW'");
  expect("\x81\x01\x01", "file: a key that is no text" + whole);
  expect(std::string("\x82\xa1" "a\x01\xa1" "a\x02"), "file: a key used twice" + whole);
  expect(outer("magic", pack::text("RCIRLX")), "magic: missing or another");
  expect(outer("schema_version", pack::natural(2)), "schema_version: 2: expected 1, all");
  expect(outer("schema_version", pack::boolean(true)), "schema_version: True");
  expect(outer("sha256", pack::text(std::string(64, '0'))), "sha256: ");
  expect(outer("sha256", pack::text("no bytes")), "sha256: ");
  expect(outer("body", pack::text("text")), "sha256: no bytes");
  expect(outer("extra", pack::nil()), "file.extra: unknown");
  expect(pack::sealed(""), "body: incomplete input" + whole);
  expect(pack::sealed(body + '\0'), "body: 1 bytes after it" + whole);
  expect(pack::sealed(pack::list({})), "body: list of 0: expected a map");
}

void test_every_cut_and_every_flipped_byte() {
  const std::string good = Example(2, 2, {2}, "relu", false).file();
  for (std::size_t size = 0; size < good.size(); ++size) {
    CHECK(refusal(good.substr(0, size)) != "taken");
  }
  for (std::size_t at = 0; at < good.size(); ++at) {
    std::string changed = good;
    changed[at] = static_cast<char>(changed[at] ^ 0x21);
    CHECK(refusal(changed) != "taken");
  }
}

void test_samples() {
  const Example e;
  const auto with = [&e](const std::string& valid, std::vector<float> shift, std::size_t m) {
    std::vector<float> raw = e.inputs(3, 9), values(m);
    raw.resize(m * e.times * e.features);
    for (std::size_t i = 0; i < m && i < 3; ++i) {
      const double value = e.value(&raw[i * e.times * e.features], nullptr);
      const double size = std::max(1.0, std::abs(value));
      values[i] = static_cast<float>(value + size * double{shift[i]});
    }
    return e.tampered("samples",
                      pack::map({{"features", pack::array({m, e.times, e.features}, raw)},
                                 {"valid", valid},
                                 {"value", pack::array({m}, values)}}));
  };
  const std::string ones = pack::filled({3, 4}, 1.0f);
  CHECK_TEXT(refusal(with(ones, {5e-6f, -5e-6f, 0.0f}, 3)), "taken");
  expect(with(ones, {0.0f, 2e-5f, 0.0f}, 3), "samples[1]: scored ");
  expect(with(pack::filled({3, 4}, 0.5f), {0, 0, 0}, 3), "samples.valid[0, 0]: 0.5: expected 0");
  expect(with(pack::filled({257, 4}, 1.0f), {0, 0, 0}, 257), "samples.value.shape: [257]");
  Example gated(3, 4, {5}, "tanh", true);
  const std::string late = pack::array({1, 4}, {0.0f, 1.0f, 1.0f, 1.0f});
  expect(gated.tampered("samples",
                        pack::map({{"features", pack::filled({1, 4, 3}, 0.5f)},
                                   {"valid", late},
                                   {"value", pack::filled({1}, 0.0f)}})),
         "samples.valid[0, 0]: 0: expected 1 at the first time");
}

void write(const std::string& path, const std::string& data) {
  std::FILE* stream = std::fopen(path.c_str(), "wb");
  CHECK(stream != nullptr && std::fwrite(data.data(), 1, data.size(), stream) == data.size());
  std::fclose(stream);
}

void test_paths(const std::string& folder) {
  rcirl::Reward reward;
  const std::string good = folder + "/good.msgpack", fifo = folder + "/fifo";
  write(good, Example().file());
  CHECK_TEXT(rcirl::load(good, &reward).message(), "");
  CHECK_TEXT(reward.file(), good);
  write(folder + "/empty", "");
  CHECK_TEXT(rcirl::load(folder + "/empty", &reward).message(),
             folder + "/empty: size: 0 bytes or more: expected 1 to 67108864 bytes");
  CHECK(mkfifo(fifo.c_str(), 0600) == 0);
  for (const std::string& path : {folder, folder + "/missing", fifo, std::string()}) {
    CHECK_TEXT(rcirl::load(path, &reward).message(),
               path + ": path: no such file: expected a file");
  }
  const rcirl::Status nul = rcirl::load(good + std::string(1, '\0'), &reward);
  CHECK_TEXT(nul.message(), good + "?: path: a NUL byte: expected a file");
  write(folder + "/big", std::string((64u << 20) + 1, '\0'));
  CHECK_TEXT(rcirl::load(folder + "/big", &reward).message(),
             folder + "/big: size: 67108865 bytes or more: expected 1 to 67108864 bytes");
}

}  // namespace

int main() {
  char folder[] = "/tmp/rcirl_load_XXXXXX";
  CHECK(mkdtemp(folder) != nullptr);
  test_a_file_and_what_it_says();
  test_fields();
  test_arrays();
  test_limits();
  test_the_outer_map();
  test_every_cut_and_every_flipped_byte();
  test_samples();
  test_paths(folder);
  for (const char* name : {"/good.msgpack", "/empty", "/fifo", "/big"}) {
    std::remove((folder + std::string(name)).c_str());
  }
  std::remove(folder);
  return failures == 0 ? 0 : 1;
}
