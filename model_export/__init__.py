"""Networks, their training, and their export to ONNX. The only package that needs torch."""
