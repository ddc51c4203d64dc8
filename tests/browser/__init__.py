"""Tests of the browser as viewer and panels."""
