"""Serve the explorer's page on this machine only: page, data, websocket, and access by a secret token."""
