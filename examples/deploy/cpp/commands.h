// The ranges of commands that a policy has seen in its training.
#pragma once

#include "joints.h"

namespace ksim {

// One command: its numbers now, and what each may be. Zero is clipped to that, too.
struct Command {
  Command(std::string name_, const Json& spec) : name(std::move(name_)) {
    const size_t size = spec["size"].count();
    low = ends(spec, "low", size, -infinity);
    high = ends(spec, "high", size, infinity);
    for (size_t k = 0; k < size; ++k) {
      if (low[k] > high[k]) throw std::runtime_error(spec.place + ": low is above high");
    }
    values = clip(Numbers(size, 0.0));
  }

  // The nearest command of the range.
  Numbers clip(Numbers wanted) const {
    for (size_t k = 0; k < wanted.size(); ++k) wanted[k] = std::min(std::max(wanted[k], low[k]), high[k]);
    return wanted;
  }

  std::string range() const {
    const auto is_open = [](double value) { return std::isinf(value); };
    if (std::all_of(low.begin(), low.end(), is_open) && std::all_of(high.begin(), high.end(), is_open)) {
      return "any numbers, as it is not known which the policy has seen";
    }
    return as_words(low) + " to " + as_words(high);
  }

  std::string name;
  Numbers low;
  Numbers high;
  Numbers values;

 private:
  static Numbers ends(const Json& spec, const char* what, size_t size, double otherwise) {
    const Json* found = spec.find(what);
    // A command without known bounds.
    if (found == nullptr || found->is_null()) return Numbers(size, otherwise);
    const Numbers values = found->numbers();
    if (values.size() != size) throw std::runtime_error(found->place + text(": expected %zu numbers", size));
    return values;
  }
};

}  // namespace ksim
