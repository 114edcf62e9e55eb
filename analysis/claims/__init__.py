"""Statements about figures, each with the tests that were named for it beforehand, and what stored runs say to them."""
