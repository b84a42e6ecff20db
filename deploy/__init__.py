"""Processes and machines: command lines and hosts enter, running services leave."""
