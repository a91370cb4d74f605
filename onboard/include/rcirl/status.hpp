// How a call that can fail answers.
#ifndef RCIRL_STATUS_HPP_
#define RCIRL_STATUS_HPP_

#include <string>
#include <string_view>

#include "rcirl/detail/text.hpp"

namespace rcirl {

// Success, or one line "FILE: field: value: expected ...".
class [[nodiscard]] Status {
 public:
  Status() = default;
  explicit Status(std::string_view message) : message_(detail::one_line(message)) {}

  bool ok() const { return message_.empty(); }
  const std::string& message() const { return message_; }

 private:
  std::string message_;
};

}  // namespace rcirl

#endif  // RCIRL_STATUS_HPP_
