"""Fits of camera poses and of exposure to images, by brightness and by features."""
