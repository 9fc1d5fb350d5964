"""Conformance suites for vectors."""
