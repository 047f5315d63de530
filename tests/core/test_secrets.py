"""Passwords are masked wherever a configuration leaves the drone."""

from __future__ import annotations

import pytest

from flockd.core.secrets import masked


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("rtspsrc location=rtsp://anna:hunter2@10.0.0.7/s", "rtspsrc location=rtsp://***@10.0.0.7/s"),
        ("rtsp://anna:h@nter2@camera", "rtsp://***@camera"),
        ("rtspsrc user-id=anna user-pw=hunter2 ! decodebin", "rtspsrc user-id=anna user-pw=*** ! decodebin"),
        ('srtsrc passphrase="two \\" words" ! x', "srtsrc passphrase=*** ! x"),
        ("tls/host:7447#private_key_base64=abc;verify=1", "tls/host:7447#private_key_base64=***;verify=1"),
        ("http://camera/video?token=abc&size=2 ! x", "http://camera/video?token=***&size=*** ! x"),
        ("location=http://c/v.cgi?usr=anna&loginpas=h!2 ! x", "location=http://c/v.cgi?usr=***&loginpas=*** ! x"),
        ("rtspsrc location='rtsp://camera/live?hunter2' ! x", "rtspsrc location='rtsp://camera/live?***' ! x"),
        ("element api-key=hunter2 ! x", "element api-key=*** ! x"),
        ("v4l2src device=/dev/video0 ! video/x-raw,width=640", "v4l2src device=/dev/video0 ! video/x-raw,width=640"),
        ("udpin://127.0.0.1:14540", "udpin://127.0.0.1:14540"),
    ],
)  # fmt: skip
def test_a_password_is_masked_and_nothing_else(text: str, shown: str) -> None:
    assert masked(text) == shown
    assert masked({"a": [text, 3, None]}) == {"a": [shown, 3, None]}
