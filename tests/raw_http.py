"""Requests to a server on this machine as no client library would send them."""

import http.client
import socket


def get(server, path, host=None, **headers):
    """The response to a path sent verbatim."""
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    connection.putrequest("GET", path, skip_host=True)
    connection.putheader("Host", f"127.0.0.1:{server.port}" if host is None else host)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    answer.content = answer.read()
    connection.close()
    return answer


def reply(server, request) -> bytes:
    """What comes back for a request that no client library would send."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=30) as raw:
        lines = f"{request.format(port=server.port)}\nConnection: close\n\n"
        raw.sendall(lines.replace("\n", "\r\n").encode())
        return b"".join(iter(lambda: raw.recv(1 << 16), b""))
