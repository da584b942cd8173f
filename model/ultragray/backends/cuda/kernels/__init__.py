"""The code of the device. Triton's compiler reads these functions; they carry no Python types. Lengths are in cm."""
