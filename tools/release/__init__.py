"""Packages, lock file, licences."""
