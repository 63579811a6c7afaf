"""Serve the page on loopback: requests for data, the websocket, the token."""
