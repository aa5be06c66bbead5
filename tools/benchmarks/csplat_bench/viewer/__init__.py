"""What the viewer takes, in a browser, and the JavaScript decoder, in Node.js."""
