"""What `tools/check_device.py` runs inside its virtual machine."""
