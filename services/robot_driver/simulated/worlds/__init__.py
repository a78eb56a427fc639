"""World files (TOML), read by `services.robot_driver.simulated.world`."""
