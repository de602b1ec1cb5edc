"""Tensors only: nodes, quadrature, interpolation and linear algebra."""
