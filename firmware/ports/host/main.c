/* A controller as a process of a POSIX system, behind a pseudo-terminal of its own.
 *
 *     host [--link PATH] [--flash FILE] [--dac FILE] [--hardware NAME] [--drift-ppm N]
 *
 * The first line of its output is the name that a host program opens. It ends by SIGTERM, SIGINT or SIGHUP, or when
 * its input ends. --link: another name for that, made and removed. --flash: keeps model images in a file, of one
 * process at a time. --dac: writes the codes there at once, int16 of this machine, channels interleaved. --drift-ppm:
 * how much faster than the system's its clock runs, within 100 000.
 */
#define _DEFAULT_SOURCE
#define _XOPEN_SOURCE 700
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/file.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "vibrocast/actuator_tables.h"
#include "vibrocast/decoder.h"
#include "vibrocast/port.h"
#include "vibrocast/sizes.h"

#define RECORD_BYTES 4096u
#define SLOT_BYTES (1u << 20)
#define FLASH_BYTES (2 * RECORD_BYTES + 2 * SLOT_BYTES)
#define WAIT_MS 2
#define MOST_DRIFT_PPM 100000
/* A loaded system may suspend the process, which no controller's own processor does. Of a longer wait, its clock counts
 * this part only. */
#define LONGEST_STEP_US 50000

static volatile sig_atomic_t ended;
static int terminal = -1;
static FILE *dac_file;
static const char dac_failure[] = "the file for DAC codes";
static int64_t drift_ppm;
static const char *link_path;

static void end(int signal_number)
{
    (void)signal_number;
    ended = 1;
}

static void fail(const char *what)
{
    fprintf(stderr, "host: %s: %s\n", what, strerror(errno));
    exit(1);
}

static void remove_link(void)
{
    unlink(link_path);
}

size_t vc_port_read(uint8_t *data, size_t capacity)
{
    const ssize_t length = read(terminal, data, capacity);
    return length > 0 ? (size_t)length : 0;
}

size_t vc_port_write(const uint8_t *data, size_t length)
{
    const ssize_t taken = write(terminal, data, length);
    return taken > 0 ? (size_t)taken : 0;
}

uint64_t vc_port_now_us(void)
{
    static int64_t read_us = -1, passed_us;
    struct timespec now;
    int64_t now_us;
    clock_gettime(CLOCK_MONOTONIC, &now);
    now_us = (int64_t)now.tv_sec * 1000000 + now.tv_nsec / 1000;
    if (read_us >= 0)
        passed_us += now_us - read_us < LONGEST_STEP_US ? now_us - read_us : LONGEST_STEP_US;
    read_us = now_us;
    return (uint64_t)(passed_us + passed_us * drift_ppm / 1000000);
}

static void play(void *context, const int16_t *codes, uint32_t samples, unsigned channels, uint64_t due_us)
{
    (void)context;
    (void)due_us;
    if (dac_file != NULL && fwrite(codes, sizeof *codes * channels, samples, dac_file) != samples)
        fail(dac_failure);
}

static int erase(void *context, uint32_t offset, uint32_t length)
{
    memset((uint8_t *)context + offset, 0xFF, length);
    return 0;
}

static int program(void *context, uint32_t offset, const uint8_t *data, uint32_t length)
{
    uint8_t *memory = (uint8_t *)context + offset;
    for (; length > 0; length--)
        *memory++ &= *data++;
    return 0;
}

/* Maps the flash; a new one is blank. `path`: of the file, NULL = memory only. */
static uint8_t *open_flash(const char *path)
{
    uint8_t *memory;
    int file = -1, fresh = 1;
    if (path != NULL) {
        struct stat status;
        file = open(path, O_RDWR | O_CREAT, 0666);
        if (file < 0 || fstat(file, &status) != 0)
            fail(path);
        if (flock(file, LOCK_EX | LOCK_NB) != 0) {
            fprintf(stderr, "host: %s: another process keeps its images there\n", path);
            exit(1);
        }
        fresh = status.st_size == 0;
        if (!fresh && status.st_size != FLASH_BYTES) {
            fprintf(stderr, "host: %s does not have the %u bytes of this flash: delete it\n", path, FLASH_BYTES);
            exit(1);
        }
        if (fresh && ftruncate(file, FLASH_BYTES) != 0)
            fail(path);
    }
    memory =
        mmap(NULL, FLASH_BYTES, PROT_READ | PROT_WRITE, file < 0 ? MAP_PRIVATE | MAP_ANONYMOUS : MAP_SHARED, file, 0);
    if (memory == MAP_FAILED)
        fail("the flash");
    if (fresh)
        memset(memory, 0xFF, FLASH_BYTES);
    return memory;
}

/* Opens a pseudo-terminal and returns the name of its other end. That stays open here, so it outlives every host
 * program that closes it. */
static const char *open_terminal(void)
{
    const char *name;
    struct termios raw;
    int other;
    terminal = posix_openpt(O_RDWR | O_NOCTTY);
    if (terminal < 0 || grantpt(terminal) != 0 || unlockpt(terminal) != 0)
        fail("no pseudo-terminal");
    name = ptsname(terminal);
    other = open(name, O_RDWR | O_NOCTTY);
    if (other < 0 || tcgetattr(other, &raw) != 0)
        fail(name);
    cfmakeraw(&raw);
    if (tcsetattr(other, TCSANOW, &raw) != 0 || fcntl(terminal, F_SETFL, O_NONBLOCK) != 0)
        fail(name);
    return name;
}

static void make_link(const char *name)
{
    if (symlink(name, link_path) != 0) {
        fprintf(stderr, "host: %s: %s%s\n", link_path, strerror(errno),
                errno == EEXIST ? ": delete it if it is of a process that was killed" : "");
        exit(1);
    }
    atexit(remove_link);
}

static int64_t profile[VC_PROFILE_WORDS];

int main(int count, char **arguments)
{
    vc_controller_settings settings = {.build = VC_BUILD,
                                       .hardware = "host",
                                       .actuator = &VC_ACTUATOR(vc_piezo_stack),
                                       .public_key = (const uint8_t *)VC_PUBLIC_KEY,
                                       .verify_signature = vc_port_verify_signature,
                                       .watchdog_ms = 2000,
                                       .profile = (vc_profile *)profile};
    vc_flash flash = {.record = {0, RECORD_BYTES},
                      .record_bytes = RECORD_BYTES,
                      .slot = {2 * RECORD_BYTES, 2 * RECORD_BYTES + SLOT_BYTES},
                      .slot_bytes = SLOT_BYTES,
                      .write_bytes = 1,
                      .erase = erase,
                      .program = program};
    static const vc_dac_port dac = {.play = play};
    const char *flash_path = NULL, *name;
    struct sigaction on_end = {.sa_handler = end};
    int index, status;
    for (index = 1; index + 1 < count; index += 2) {
        const char *option = arguments[index], *value = arguments[index + 1];
        char *rest;
        if (strcmp(option, "--link") == 0)
            link_path = value;
        else if (strcmp(option, "--flash") == 0)
            flash_path = value;
        else if (strcmp(option, "--hardware") == 0 && strlen(value) < 64)
            settings.hardware = value;
        else if (strcmp(option, "--serial-number") == 0 && strlen(value) < 32)
            settings.serial_number = value;
        else if (strcmp(option, "--drift-ppm") == 0) {
            drift_ppm = strtol(value, &rest, 10);
            if (*value == '\0' || *rest != '\0' || drift_ppm > MOST_DRIFT_PPM || drift_ppm < -MOST_DRIFT_PPM)
                break;
        } else if (strcmp(option, "--dac") != 0)
            break;
        else if ((dac_file = fopen(value, "wb")) == NULL || setvbuf(dac_file, NULL, _IONBF, 0) != 0)
            fail(value);
    }
    if (index != count) {
        fprintf(stderr, "usage: host [--link PATH] [--flash FILE] [--dac FILE] [--hardware NAME] "
                        "[--serial-number TEXT] [--drift-ppm N]\n");
        return 2;
    }
    sigaction(SIGTERM, &on_end, NULL);
    sigaction(SIGINT, &on_end, NULL);
    sigaction(SIGHUP, &on_end, NULL);
    flash.context = open_flash(flash_path);
    flash.base = flash.context;
    status = vc_loop_start(&settings, &flash, &dac);
    if (status != VC_OK) {
        fprintf(stderr, "host: %s\n", vc_status_text(status));
        return 1;
    }
    name = open_terminal();
    if (link_path != NULL)
        make_link(name);
    printf("%s\n", name);
    fflush(stdout);
    while (!ended) {
        struct pollfd wanted[2] = {{terminal, POLLIN, 0}, {STDIN_FILENO, POLLIN, 0}};
        char ignored[256];
        if (vc_loop_turn() || poll(wanted, 2, WAIT_MS) <= 0)
            continue;
        if (wanted[1].revents != 0 && read(STDIN_FILENO, ignored, sizeof ignored) <= 0)
            break;
    }
    if (dac_file != NULL && fclose(dac_file) != 0)
        fail(dac_failure);
    return 0;
}
