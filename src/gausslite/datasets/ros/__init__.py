"""ROS messages and bags as frames: conversion of messages, transforms, choice of topics, bag files."""
