"""What `tools/checks/check_device.py` runs inside its virtual machine."""
