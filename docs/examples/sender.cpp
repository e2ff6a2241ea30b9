// A tracker that sends ten frames to a listening run (docs/tracker_server.md). It needs no library.
#include <arpa/inet.h>
#include <sys/socket.h>
#include <unistd.h>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <vector>

#pragma pack(push, 1)
struct Header { char magic[4] = {'M', 'O', 'D', 'P'}; uint16_t version = 1, kind; uint32_t length, zero = 0; };
struct Hello { uint32_t width, height, encoding, lens; double fx, fy, cx, cy, k[8]; };
struct Frame { uint32_t number, state; double time, T_camera_world[16]; uint32_t points, image_bytes; };
struct Point { int64_t id; double xyz[3], pixel[2]; };
#pragma pack(pop)

static void write_all(int server, const void* data, size_t size) {
    for (const char* at = static_cast<const char*>(data); size > 0;) {
        ssize_t written = send(server, at, size, MSG_NOSIGNAL);
        if (written <= 0) { perror("the server has closed the connection"); exit(1); }
        at += written; size -= written;
    }
}

static void send_message(int server, uint16_t kind, const std::vector<std::pair<const void*, size_t>>& parts) {
    Header header; header.kind = kind; header.length = 0;
    for (auto& part : parts) header.length += part.second;
    write_all(server, &header, sizeof header);
    for (auto& part : parts) write_all(server, part.first, part.second);
}

int main(int argc, char** argv) {
    int server = socket(AF_INET, SOCK_STREAM, 0);
    sockaddr_in to{}; to.sin_family = AF_INET; to.sin_port = htons(argc > 1 ? atoi(argv[1]) : 7007);
    inet_pton(AF_INET, "127.0.0.1", &to.sin_addr);
    if (connect(server, reinterpret_cast<sockaddr*>(&to), sizeof to)) { perror("no server is listening"); return 1; }
    Hello hello{64, 48, 4, 0, 60, 60, 32, 24, {}};
    send_message(server, 1, {{&hello, sizeof hello}});
    for (uint32_t i = 0; i < 10; i++) {
        std::vector<uint8_t> image(64 * 48 * 3, uint8_t(20 * i));           // what the camera saw
        std::vector<Point> points{{7, {0.05 * i, 0, 3}, {32, 24}}};        // what the tracker knows
        Frame frame{i, 1, i / 30.0, {1,0,0,-0.05 * i, 0,1,0,0, 0,0,1,0, 0,0,0,1}, uint32_t(points.size()), uint32_t(image.size())};
        send_message(server, 2, {{&frame, sizeof frame}, {points.data(), points.size() * sizeof(Point)}, {image.data(), image.size()}});
    }
    send_message(server, 5, {});
    char answer[256]; ssize_t size, last = 0;
    while ((size = read(server, answer, sizeof answer)) > 0) last = size;
    printf("%u frames taken\n", last >= 20 ? *reinterpret_cast<uint32_t*>(answer + last - 4) : 0);
    close(server);
}
