"""Foundations of all packages: errors, equality by value, tables and wording, linear algebra, caching."""
