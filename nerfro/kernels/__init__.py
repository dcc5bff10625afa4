"""Shared functions of compiled kernels; tests compare each kernel with a reference implementation in PyTorch."""
