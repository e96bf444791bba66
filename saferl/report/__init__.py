"""Folders of runs to the paper's tables, its claims and its curves: numbers first, their formats apart."""
