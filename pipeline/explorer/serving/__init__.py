"""Serve the explorer on this machine only: page, data requests, websocket, and access control by a token."""
