"""Turn a run into a policy for others: ``python -m saferl.export checkpoint=RUN out=DIR format=onnx``."""

from saferl.cli.launch import launch

if __name__ == "__main__":
    launch("export", "export")
