"""ONNX models: files loaded and checked against the rules that use them, and run for many clients at once."""
