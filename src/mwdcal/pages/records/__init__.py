"""Certificates as pages and PDF, and pages of the registry."""
