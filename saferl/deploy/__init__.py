"""Policies for those who have no saferl: as one graph, in files of PyTorch and ONNX, with a card."""
