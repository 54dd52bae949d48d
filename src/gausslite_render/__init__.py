"""Render splat maps of any trainer, with colours that depend on the view, along poses of any tool."""
