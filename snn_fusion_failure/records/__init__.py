"""Rows of record, statistics over seeds, and the pages that show them."""
