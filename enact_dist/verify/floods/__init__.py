"""Floods of one client beside the updates of another: real daemons, an attacker, a judge."""
