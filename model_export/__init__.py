"""Define networks, train them and export them to ONNX. Only this package requires torch."""
