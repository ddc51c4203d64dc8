"""Definition and training of networks, and their export to ONNX. Only this package requires torch."""
