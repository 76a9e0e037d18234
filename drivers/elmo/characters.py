"""The characters of the ASCII interpreter's language as numbers, for kernels, which handle bytes."""

CR, SEMICOLON, QUESTION_MARK = 0x0D, 0x3B, 0x3F
PLUS, MINUS, POINT, EQUALS = 0x2B, 0x2D, 0x2E, 0x3D
ZERO, NINE = 0x30, 0x39
