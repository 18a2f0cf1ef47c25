"""The world: hardware tables, layouts, physics, rewards, environment. Imports nothing above it."""
