"""Networks, their training and their export to ONNX. Only this package needs torch."""
