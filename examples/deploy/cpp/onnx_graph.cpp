// Computes graphs by onnxruntime's C interface, which every release of it has had, in the same order of functions.

#include <onnxruntime_c_api.h>

#include "network.h"

namespace ksim {
namespace {

const OrtApi& api() {
  static const OrtApi* const found = OrtGetApiBase()->GetApi(ORT_API_VERSION);
  if (found == nullptr) throw std::runtime_error("the library of onnxruntime is older than the header");
  return *found;
}

void check(OrtStatus* status) {
  if (status == nullptr) return;
  const std::string why = api().GetErrorMessage(status);
  api().ReleaseStatus(status);
  throw std::runtime_error("onnxruntime: " + why);
}

// Objects of onnxruntime, each with what releases it.
template <typename Object>
using Owned = std::unique_ptr<Object, void (*)(Object*)>;

template <typename Object>
Owned<Object> owned(Object* object, void (*release)(Object*)) {
  return Owned<Object>(object, release);
}

OrtEnv* environment() {
  static OrtEnv* const found = [] {
    OrtEnv* made = nullptr;
    check(api().CreateEnv(ORT_LOGGING_LEVEL_WARNING, "loop", &made));
    return made;
  }();
  return found;
}

// The numbers of one robot's tensor, as the type that the graph has.
struct Tensor {
  Port port;
  ONNXTensorElementDataType type = ONNX_TENSOR_ELEMENT_DATA_TYPE_UNDEFINED;
  std::vector<unsigned char> bytes;

  template <typename Number>
  void fill_as(const Numbers& values) {
    bytes.resize(values.size() * sizeof(Number));
    auto* numbers = reinterpret_cast<Number*>(bytes.data());
    for (size_t k = 0; k < values.size(); ++k) numbers[k] = static_cast<Number>(values[k]);
  }

  void fill(const Numbers& values) {
    switch (type) {
      case ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT:
        return fill_as<float>(values);
      case ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64:
        return fill_as<int64_t>(values);
      case ONNX_TENSOR_ELEMENT_DATA_TYPE_BOOL:
      case ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8:
        return fill_as<uint8_t>(values);
      default:
        throw std::runtime_error("the input " + port.name + " is of a type that no export writes");
    }
  }
};

template <typename Number>
Numbers numbers_as(const void* data, size_t size) {
  const auto* numbers = static_cast<const Number*>(data);
  return Numbers(numbers, numbers + size);
}

Numbers numbers_of(OrtValue* value) {
  OrtTensorTypeAndShapeInfo* info = nullptr;
  check(api().GetTensorTypeAndShape(value, &info));
  const auto kept = owned(info, api().ReleaseTensorTypeAndShapeInfo);
  size_t size = 0;
  check(api().GetTensorShapeElementCount(info, &size));
  ONNXTensorElementDataType type = ONNX_TENSOR_ELEMENT_DATA_TYPE_UNDEFINED;
  check(api().GetTensorElementType(info, &type));
  void* data = nullptr;
  check(api().GetTensorMutableData(value, &data));
  switch (type) {
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT:
      return numbers_as<float>(data, size);
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_INT64:
      return numbers_as<int64_t>(data, size);
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_BOOL:
    case ONNX_TENSOR_ELEMENT_DATA_TYPE_UINT8:
      return numbers_as<uint8_t>(data, size);
    default:
      throw std::runtime_error("an output is of a type that no export writes");
  }
}

class OnnxGraph : public Graph {
 public:
  explicit OnnxGraph(const std::string& path)
      : session_(nullptr, api().ReleaseSession), memory_(nullptr, api().ReleaseMemoryInfo) {
    OrtSessionOptions* options = nullptr;
    check(api().CreateSessionOptions(&options));
    const auto kept = owned(options, api().ReleaseSessionOptions);
    // A small network gains nothing from threads.
    check(api().SetIntraOpNumThreads(options, 1));
    check(api().SetInterOpNumThreads(options, 1));
    OrtSession* session = nullptr;
    check(api().CreateSession(environment(), path.c_str(), options, &session));
    session_.reset(session);
    OrtMemoryInfo* memory = nullptr;
    check(api().CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &memory));
    memory_.reset(memory);
    size_t count = 0;
    check(api().SessionGetInputCount(session, &count));
    for (size_t k = 0; k < count; ++k) {
      tensors_.push_back(read_input(k));
      ports_.push_back(tensors_.back().port);
    }
  }

  const std::vector<Port>& inputs() const override { return ports_; }

  std::vector<Numbers> run(const Values& given, const Names& outputs) override {
    std::vector<Owned<OrtValue>> kept;
    std::vector<const OrtValue*> values;
    std::vector<const char*> names;
    for (auto& tensor : tensors_) {
      const auto numbers = given.find(tensor.port.name);
      if (numbers == given.end()) throw std::runtime_error("nothing fills the input " + tensor.port.name);
      tensor.fill(numbers->second);
      kept.push_back(value_of(tensor));
      values.push_back(kept.back().get());
      names.push_back(tensor.port.name.c_str());
    }
    std::vector<const char*> wanted;
    for (const auto& name : outputs) wanted.push_back(name.c_str());
    std::vector<OrtValue*> found(outputs.size(), nullptr);
    OrtStatus* status = api().Run(session_.get(), nullptr, names.data(), values.data(), values.size(), wanted.data(),
                                  wanted.size(), found.data());
    std::vector<Owned<OrtValue>> results;
    for (OrtValue* value : found) results.push_back(owned(value, api().ReleaseValue));
    check(status);
    std::vector<Numbers> numbers;
    for (const auto& result : results) numbers.push_back(numbers_of(result.get()));
    return numbers;
  }

 private:
  Tensor read_input(size_t place) const {
    OrtAllocator* allocator = nullptr;
    check(api().GetAllocatorWithDefaultOptions(&allocator));
    char* name = nullptr;
    check(api().SessionGetInputName(session_.get(), place, allocator, &name));
    Tensor tensor;
    tensor.port.name = name;
    check(api().AllocatorFree(allocator, name));
    OrtTypeInfo* type = nullptr;
    check(api().SessionGetInputTypeInfo(session_.get(), place, &type));
    const auto kept = owned(type, api().ReleaseTypeInfo);
    const OrtTensorTypeAndShapeInfo* info = nullptr;
    check(api().CastTypeInfoToTensorInfo(type, &info));
    check(api().GetTensorElementType(info, &tensor.type));
    size_t rank = 0;
    check(api().GetDimensionsCount(info, &rank));
    tensor.port.shape.resize(rank);
    check(api().GetDimensions(info, tensor.port.shape.data(), rank));
    for (int64_t& edge : tensor.port.shape) {
      // A batch of any size has a name in place of a number: here is one robot.
      if (edge < 0) edge = 1;
    }
    return tensor;
  }

  Owned<OrtValue> value_of(Tensor& tensor) const {
    OrtValue* value = nullptr;
    check(api().CreateTensorWithDataAsOrtValue(memory_.get(), tensor.bytes.data(), tensor.bytes.size(),
                                               tensor.port.shape.data(), tensor.port.shape.size(), tensor.type, &value));
    return owned(value, api().ReleaseValue);
  }

  Owned<OrtSession> session_;
  Owned<OrtMemoryInfo> memory_;
  std::vector<Tensor> tensors_;
  std::vector<Port> ports_;
};

}  // namespace

std::unique_ptr<Graph> open_graph(const std::string& path) { return std::make_unique<OnnxGraph>(path); }

}  // namespace ksim
