"""Fits of camera poses to images, by brightness and by features."""
