// Sends an ADXL345 accelerometer at 3200 Hz as binary frames: docs/reference/serial_sensors.md.
#include <SPI.h>

const int SELECT = 10;
const char FACTS[] = "rate_hz=3200 unit=g counts_per_unit=256 full_scale=16 axes=xyz";
const SPISettings BUS(5000000, MSBFIRST, SPI_MODE3);
uint8_t payload[128];

// Sends a frame: COBS of the payload and its CRC-16 (polynomial 0x1021, start 0xFFFF), then a zero byte.
void sendFrame(uint8_t length) {
  uint16_t crc = 0xFFFF;
  for (uint8_t i = 0; i < length; i++) {
    crc ^= (uint16_t)payload[i] << 8;
    for (uint8_t bit = 0; bit < 8; bit++) crc = crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1;
  }
  payload[length++] = crc & 0xFF;
  payload[length++] = crc >> 8;
  uint8_t start = 0;
  for (uint8_t i = 0; i <= length; i++) {  // frames are shorter than 254 bytes
    if (i < length && payload[i] != 0) continue;
    Serial.write((uint8_t)(i - start + 1));
    Serial.write(payload + start, i - start);
    start = i + 1;
  }
  Serial.write((uint8_t)0);
}

void set(uint8_t registerAddress, uint8_t value) {
  SPI.beginTransaction(BUS);
  digitalWrite(SELECT, LOW);
  SPI.transfer(registerAddress);
  SPI.transfer(value);
  digitalWrite(SELECT, HIGH);
  SPI.endTransaction();
}

uint8_t get(uint8_t registerAddress, uint8_t count, uint8_t* values) {
  SPI.beginTransaction(BUS);
  digitalWrite(SELECT, LOW);
  SPI.transfer(0xC0 | registerAddress);  // read several
  for (uint8_t i = 0; i < count; i++) values[i] = SPI.transfer(0);
  digitalWrite(SELECT, HIGH);
  SPI.endTransaction();
  return values[0];
}

void setup() {
  Serial.begin(500000);
  pinMode(SELECT, OUTPUT);
  digitalWrite(SELECT, HIGH);
  SPI.begin();
  set(0x2C, 0x0F);  // 3200 samples a second
  set(0x31, 0x0B);  // +-16 g, 256 counts for one g
  set(0x2D, 0x08);  // measure
}

void loop() {
  static uint32_t number = 0;
  static uint32_t described = 0;
  if (number == 0 || number - described >= 3200) {
    payload[0] = 1;
    memcpy(payload + 1, FACTS, sizeof FACTS - 1);
    sendFrame(sizeof FACTS);
    described = number;
  }
  payload[0] = 2;
  memcpy(payload + 1, &number, 4);
  for (uint8_t sample = 0; sample < 16; sample++, number++) {
    uint8_t source;
    while (!(get(0x30, 1, &source) & 0x80)) {}  // wait for the next sample
    if (source & 0x01) number++;                // the sensor has overwritten one
    get(0x32, 6, payload + 5 + 6 * sample);
  }
  sendFrame(5 + 6 * 16);
}
