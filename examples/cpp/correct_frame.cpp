// Corrects one frame with corrector.ts, without Python.
//
//   correct_frame corrector.ts depth.raw amplitude.raw corrected.raw
//
// The frames are raw float32 in the machine's byte order, row after row, metres and the camera's
// amplitude units; their size is the one that the corrector was calibrated for. Exit code 2 and
// one line on standard error if something is wrong.

#include <torch/script.h>

#include <fstream>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

struct FrameSize {
  int64_t height;
  int64_t width;
};

// The corrector's metadata is JSON; its camera's numbers are all that this program needs of it.
int64_t number_in(const std::string& json, const std::string& key) {
  const auto place = json.find("\"" + key + "\":");
  if (place == std::string::npos) {
    throw std::runtime_error("the corrector's metadata has no \"" + key + "\"");
  }
  return std::stoll(json.substr(place + key.size() + 3));
}

FrameSize frame_size(torch::jit::Module& corrector) {
  const std::string metadata = corrector.get_method("metadata")({}).toStringRef();
  return {number_in(metadata, "height"), number_in(metadata, "width")};
}

torch::Tensor read_frame(const std::string& path, FrameSize size) {
  std::ifstream file(path, std::ios::binary);
  auto frame = torch::empty({size.height, size.width}, torch::kFloat32);
  const auto bytes = static_cast<std::streamsize>(frame.nbytes());
  file.read(static_cast<char*>(frame.data_ptr()), bytes);
  if (file.gcount() != bytes || file.peek() != std::ifstream::traits_type::eof()) {
    throw std::runtime_error(path + ": expected " + std::to_string(size.height) + " x " +
                             std::to_string(size.width) + " float32 values");
  }
  return frame;
}

void write_frame(const std::string& path, const torch::Tensor& frame) {
  std::ofstream file(path, std::ios::binary);
  const auto whole = frame.contiguous();
  file.write(static_cast<const char*>(whole.data_ptr()),
             static_cast<std::streamsize>(whole.nbytes()));
  if (!file) throw std::runtime_error(path + ": cannot be written");
}

void run(const std::vector<std::string>& paths) {
  torch::NoGradGuard no_gradients;
  torch::jit::Module corrector = torch::jit::load(paths[0]);
  const FrameSize size = frame_size(corrector);
  const auto depth = read_frame(paths[1], size);
  const auto amplitude = read_frame(paths[2], size);
  const auto result = corrector.forward({depth, amplitude}).toTuple();
  const auto corrected = result->elements()[0].toTensor();
  const auto valid = result->elements()[1].toTensor();
  write_frame(paths[3], corrected);
  std::cout << valid.sum().item<int64_t>() << " of " << valid.numel() << " pixels valid\n";
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 5) {
    std::cerr << "usage: correct_frame corrector.ts depth.raw amplitude.raw corrected.raw\n";
    return 2;
  }
  try {
    run({argv + 1, argv + argc});
  } catch (const std::exception& error) {
    const std::string text = error.what();
    std::cerr << "correct_frame: " << text.substr(0, text.find('\n')) << "\n";
    return 2;
  }
  return 0;
}
