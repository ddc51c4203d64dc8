"""Networks, their training and their export to ONNX. No other package needs torch."""
