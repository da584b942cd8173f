using System;
using System.Globalization;

namespace Ultragray
{
    /// <summary>A class of the contract that is sent.</summary>
    public interface IWritable
    {
        void Write(JsonWriter json);
    }

    /// <summary>JSON in UTF-8, in one array that grows. Members that are null are left out.</summary>
    public sealed class JsonWriter
    {
        static readonly Action<JsonWriter, double> WriteNumber = (json, value) => json.Put(value);
        static readonly Action<JsonWriter, string> WriteText = (json, value) => json.Quote(value);
        static readonly Action<JsonWriter, IWritable> WriteObject = (json, value) => value.Write(json);
        readonly char[] digits = new char[32];
        byte[] bytes = new byte[256];
        int count;
        bool isFirst = true;

        public ArraySegment<byte> Written => new ArraySegment<byte>(bytes, 0, count);

        /// <summary>As C takes a text: ended by a 0; null for null.</summary>
        public static byte[] Text(IWritable value)
        {
            if (value == null) return null;
            var json = new JsonWriter();
            value.Write(json);
            json.Put('\0');
            return json.Written.ToArray();
        }

        public void Clear()
        {
            count = 0;
            isFirst = true;
        }

        public void Open(char bracket)
        {
            Put(bracket);
            isFirst = true;
        }

        public void Close(char bracket)
        {
            Put(bracket);
            isFirst = false;
        }

        public void Name(string name)
        {
            Separate();
            Quote(name);
            Put(':');
        }

        public void Member(string name, bool value)
        {
            Name(name);
            Put(value ? "true" : "false");
        }

        public void Member(string name, long? value)
        {
            if (value == null) return;
            int used;
            Name(name);
            value.Value.TryFormat(new Span<char>(digits), out used, default(ReadOnlySpan<char>), CultureInfo.InvariantCulture);
            Put(used);
        }

        public void Member(string name, double? value)
        {
            if (value == null) return;
            Name(name);
            Put(value.Value);
        }

        public void Member(string name, string value)
        {
            if (value == null) return;
            Name(name);
            Quote(value);
        }

        public void Member(string name, IWritable value)
        {
            if (value == null) return;
            Name(name);
            value.Write(this);
        }

        public void Member(string name, double[] values) => List(name, values, WriteNumber);

        public void Member(string name, string[] values) => List(name, values, WriteText);

        public void Member(string name, IWritable[] values) => List(name, values, WriteObject);

        void List<T>(string name, T[] values, Action<JsonWriter, T> write)
        {
            if (values == null) return;
            Name(name);
            Open('[');
            foreach (var value in values)
            {
                Separate();
                write(this, value);
            }
            Close(']');
        }

        void Separate()
        {
            if (!isFirst) Put(',');
            isFirst = false;
        }

        void Quote(string text)
        {
            Put('"');
            foreach (char one in text)
            {
                if (one == '"' || one == '\\') Put('\\');
                if (one < ' ' || one > '~') Put("\\u" + ((int)one).ToString("x4"));
                else Put(one);
            }
            Put('"');
        }

        /// <summary>The fewest digits that are this double again.</summary>
        void Put(double value)
        {
            if (double.IsNaN(value) || double.IsInfinity(value)) throw new ArgumentException("numbers must be finite, got " + value);
            int used;
            value.TryFormat(new Span<char>(digits), out used, "R".AsSpan(), CultureInfo.InvariantCulture);
            Put(used);
        }

        void Put(int used)
        {
            for (int i = 0; i < used; i++) Put(digits[i]);
        }

        void Put(string text)
        {
            foreach (char one in text) Put(one);
        }

        void Put(char one)
        {
            if (count == bytes.Length) Array.Resize(ref bytes, 2 * count);
            bytes[count++] = (byte)one;
        }
    }
}
