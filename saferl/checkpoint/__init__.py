"""What a run holds, on disk and back."""
