"""Conversion of arrays to 8-bit pictures: false colors, contact sheets, layers, and pictures in web pages."""
