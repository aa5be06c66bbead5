"""Benchmarks of the viewer, in a browser, and of the JavaScript decoder, in Node.js."""
