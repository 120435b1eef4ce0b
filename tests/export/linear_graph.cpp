// Computes the matrices of a folder that is made by hand, so that the loop in C++ is tested without onnxruntime.
//
// Beside a graph's file stands one with `.txt` at its end: the number of inputs, name and size of each, the number of
// outputs, and a row of numbers for each column of the inputs side by side.

#include <fstream>

#include "network.h"

namespace ksim {

class LinearGraph : public Graph {
 public:
  explicit LinearGraph(const std::string& path) {
    std::ifstream file(path + ".txt");
    size_t count = 0;
    file >> count;
    for (size_t k = 0; k < count; ++k) {
      std::string name;
      int64_t size = 0;
      file >> name >> size;
      ports_.push_back({name, {1, size}});
    }
    file >> num_outputs_;
    for (double weight = 0.0; file >> weight;) weights_.push_back(weight);
    if (weights_.empty()) throw std::runtime_error(path + ".txt has no numbers");
  }

  const std::vector<Port>& inputs() const override { return ports_; }

  std::vector<Numbers> run(const Values& given, const Names&) override {
    Numbers found(num_outputs_, 0.0);
    size_t row = 0;
    for (const auto& port : ports_) {
      for (double value : given.at(port.name)) {
        for (size_t k = 0; k < num_outputs_; ++k) found[k] += value * weights_.at(row * num_outputs_ + k);
        ++row;
      }
    }
    return {found};
  }

 private:
  std::vector<Port> ports_;
  size_t num_outputs_ = 0;
  Numbers weights_;
};

std::unique_ptr<Graph> open_graph(const std::string& path) { return std::make_unique<LinearGraph>(path); }

}  // namespace ksim
