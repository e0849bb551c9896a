"""The Zaber stand-in judged by the vendor's own client: what that accepts is the protocol."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.standins.tcp_server import TcpServer
from tests.standins.zaber_device import ZaberChain, ZaberDevice

zaber_motion = pytest.importorskip("zaber_motion", reason="needs the vendor's client, zaber-motion")
ascii_ = pytest.importorskip("zaber_motion.ascii")


@pytest.fixture
def chain() -> ZaberChain:
    return ZaberChain(ZaberDevice(address=1), ZaberDevice(address=2))


@pytest.fixture
def vendor(chain: ZaberChain) -> Iterator[object]:
    with TcpServer(chain) as server, ascii_.Connection.open_tcp("127.0.0.1", server.port) as connection:
        yield connection


@pytest.mark.parametrize("in_requests", [False, True])
@pytest.mark.parametrize("in_replies", ["0", "1"])
def test_ids_and_checksums_are_accepted(chain: ZaberChain, vendor, in_requests: bool, in_replies: str) -> None:
    vendor.checksum_enabled = in_requests
    chain.checksums_required = in_requests
    chain.devices[0].settings["comm.checksum"] = in_replies
    for _ in range(3):
        reply = vendor.generic_command("get limit.max", device=1, axis=1)
        assert (reply.device_address, reply.axis_number) == (1, 1)
        assert (reply.reply_flag, reply.status, reply.warning_flag, reply.data) == ("OK", "IDLE", "WR", "6000000")


def test_checksum_that_is_wrong_is_noticed_by_the_vendor(chain: ZaberChain, vendor) -> None:
    chain.devices[0].settings["comm.checksum"] = "1"
    chain.change_reply = lambda reply: reply.replace(b"6000000", b"6000001")
    with pytest.raises(zaber_motion.exceptions.MotionLibException):
        vendor.generic_command("get limit.max", device=1, axis=1, timeout=300)


def test_rejections_carry_their_reason(vendor) -> None:
    for command, axis, reason in (
        ("no such command", 1, "BADCOMMAND"),
        ("move abs 6000001", 1, "BADDATA"),
        ("get pos", 2, "BADAXIS"),
    ):
        with pytest.raises(zaber_motion.exceptions.CommandFailedException) as caught:
            vendor.generic_command(command, device=1, axis=axis)
        assert caught.value.details.response_data == reason


@pytest.mark.parametrize("in_replies", ["0", "1"])
def test_replies_in_several_messages_are_put_together_by_the_vendor(chain: ZaberChain, vendor, in_replies: str) -> None:
    chain.devices[0].flags = {"FS", "WS", "WM", "WV", "WT", "WR"}
    chain.devices[0].settings["comm.checksum"] = in_replies
    chain.longest_data = 8
    reply = vendor.generic_command("warnings", device=1, axis=1)
    assert set(reply.data.split()) == {"06", "FS", "WS", "WM", "WV", "WT", "WR"}


def test_the_vendor_homes_moves_and_reads_warnings(chain: ZaberChain, vendor) -> None:
    axis = vendor.get_device(1).get_axis(1)
    assert axis.warnings.get_flags() == {"WR"}
    axis.home()
    assert axis.warnings.get_flags() == set()
    axis.generic_command("move abs 3000000")
    assert axis.is_busy()
    axis.wait_until_idle()
    assert axis.settings.get("pos") == 3000000
    assert chain.devices[0].position == 3000000


def test_the_vendor_stops_a_move(vendor) -> None:
    axis = vendor.get_device(2).get_axis(1)
    axis.home()
    axis.generic_command("set maxspeed 1000000")
    axis.generic_command("move abs 3000000")
    axis.stop()
    assert not axis.is_busy()
    assert 0 <= axis.settings.get("pos") < 3000000
