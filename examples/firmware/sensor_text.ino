// Sends an ADXL345 accelerometer as lines of text, about 800 a second: docs/reference/serial_sensors.md.
#include <Wire.h>

const uint8_t SENSOR = 0x53;

void set(uint8_t registerAddress, uint8_t value) {
  Wire.beginTransmission(SENSOR);
  Wire.write(registerAddress);
  Wire.write(value);
  Wire.endTransmission();
}

void setup() {
  Serial.begin(500000);
  Wire.begin();
  Wire.setClock(400000);
  set(0x2C, 0x0D);  // 800 samples a second
  set(0x31, 0x0B);  // +-16 g, 256 counts for one g
  set(0x2D, 0x08);  // measure
}

void loop() {
  static uint32_t lines = 0;
  if (lines++ % 800 == 0) Serial.println("# unit=g counts_per_unit=256 full_scale=16 axes=xyz");
  while (true) {  // wait for the next sample
    Wire.beginTransmission(SENSOR);
    Wire.write(0x30);
    Wire.endTransmission(false);
    Wire.requestFrom(SENSOR, (uint8_t)1);
    if (Wire.read() & 0x80) break;
  }
  uint32_t now = micros();
  Wire.beginTransmission(SENSOR);
  Wire.write(0x32);
  Wire.endTransmission(false);
  Wire.requestFrom(SENSOR, (uint8_t)6);
  Serial.print(now);
  for (int axis = 0; axis < 3; axis++) {
    int16_t value = Wire.read();
    value |= Wire.read() << 8;
    Serial.print(',');
    Serial.print(value);
  }
  Serial.println();
}
