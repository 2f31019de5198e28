"""What runs a network: OpenVINO, ONNX Runtime, torch."""
