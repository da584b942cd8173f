using System;
using System.Buffers.Text;
using System.Collections.Generic;
using System.Text;

namespace Ultragray
{
    /// <summary>A class of the contract that JSON fills: members that it does not know are skipped.</summary>
    public interface IReadable
    {
        void Read(JsonReader json);
    }

    /// <summary>
    /// A cursor over JSON in UTF-8. What is read takes the place of values that are there: a text that has not changed stays
    /// the same string, and an array of the same length the same array, so that the header of a frame makes no garbage.
    /// Throws FormatException for what is not what was asked for.
    /// </summary>
    public sealed class JsonReader
    {
        internal static readonly Func<JsonReader, double, double> ReadNumber = (json, current) => json.Number();
        internal static readonly Func<JsonReader, string, string> ReadText = (json, current) => json.Text(current);
        static readonly Func<JsonReader, double[], double[]> ReadNumbers = (json, current) => json.Numbers(current);

        static class OfClass<T> where T : class, IReadable, new()
        {
            internal static readonly Func<JsonReader, T, T> Read = (json, current) => json.Object(current);
        }

        byte[] text;
        int at, end, name, nameEnd;

        public JsonReader(byte[] text)
        {
            Begin(text, 0, text.Length);
        }

        public void Begin(byte[] text, int begin, int end)
        {
            this.text = text;
            at = begin;
            this.end = end;
        }

        /// <summary>Goes into an object, by '{', or a list, by '['. False for null.</summary>
        public bool Enter(char open)
        {
            if (IsNull()) return false;
            Require(open);
            return true;
        }

        /// <summary>Goes to the value of the next member of the object; false after the last one, behind the object.</summary>
        public bool NextMember()
        {
            if (!Next('}')) return false;
            SkipText(out name, out nameEnd);
            Require(':');
            return true;
        }

        /// <summary>Goes to the next element of the list; false after the last one, behind the list.</summary>
        public bool NextElement() => Next(']');

        /// <summary>Whether the member that was gone to is called so.</summary>
        public bool Named(string expected) => Holds(name, nameEnd, expected);

        public bool IsNull()
        {
            if (Peek() != 'n') return false;
            Require("null");
            return true;
        }

        public double Number()
        {
            double value;
            int used;
            Peek();
            if (!Utf8Parser.TryParse(new ReadOnlySpan<byte>(text, at, end - at), out value, out used)) throw Fault("a number");
            at += used;
            return value;
        }

        public long Integer()
        {
            long value;
            int used;
            Peek();
            if (!Utf8Parser.TryParse(new ReadOnlySpan<byte>(text, at, end - at), out value, out used)) throw Fault("an integer");
            at += used;
            return value;
        }

        public double? NumberOrNull() => IsNull() ? null : (double?)Number();

        public long? IntegerOrNull() => IsNull() ? null : (long?)Integer();

        public bool Flag()
        {
            bool value = Peek() == 't';
            Require(value ? "true" : "false");
            return value;
        }

        /// <summary>A text, or null.</summary>
        public string Text(string current)
        {
            if (IsNull()) return null;
            int begin, stop;
            SkipText(out begin, out stop);
            return current != null && Holds(begin, stop, current) ? current : Decoded(begin, stop);
        }

        /// <summary>The place of a text among the words that it may be.</summary>
        public int Word(string[] words)
        {
            int begin, stop;
            SkipText(out begin, out stop);
            for (int place = 0; place < words.Length; place++)
                if (Holds(begin, stop, words[place])) return place;
            throw Fault("one of " + string.Join(", ", words) + " before what follows");
        }

        public double[] Numbers(double[] current) => Elements(current, ReadNumber);

        public double[][] Rows(double[][] current) => Elements(current, ReadNumbers);

        public string[] Texts(string[] current) => Elements(current, ReadText);

        public T[] Objects<T>(T[] current) where T : class, IReadable, new() => Elements(current, OfClass<T>.Read);

        public T Object<T>(T current) where T : class, IReadable, new()
        {
            if (IsNull()) return null;
            var it = current ?? new T();
            it.Read(this);
            return it;
        }

        /// <summary>The elements of a list, each read into the one that has its place; null for null.</summary>
        public T[] Elements<T>(T[] current, Func<JsonReader, T, T> read)
        {
            if (!Enter('[')) return null;
            var found = current ?? new T[0];
            int count = 0;
            for (; NextElement(); count++)
            {
                if (count == found.Length) Array.Resize(ref found, Math.Max(4, 2 * count));
                found[count] = read(this, found[count]);
            }
            if (found.Length != count) Array.Resize(ref found, count);
            return found;
        }

        public Dictionary<string, T> Map<T>(Func<JsonReader, T, T> read)
        {
            if (!Enter('{')) return null;
            var found = new Dictionary<string, T>();
            while (NextMember())
            {
                string key = Decoded(name, nameEnd);
                found[key] = read(this, default(T));
            }
            return found;
        }

        /// <summary>The text of a member of the object that comes next, which stays the one to read.</summary>
        public string PeekText(string member, string current)
        {
            int begin = at;
            string found = null;
            Require('{');
            while (NextMember())
            {
                if (Named(member)) found = Text(current);
                else Skip();
            }
            at = begin;
            return found;
        }

        public void Skip()
        {
            switch (Peek())
            {
                case '{':
                    for (Require('{'); NextMember();) Skip();
                    break;
                case '[':
                    for (Require('['); NextElement();) Skip();
                    break;
                case '"':
                    SkipText(out name, out nameEnd);
                    break;
                case 't':
                case 'f':
                    Flag();
                    break;
                default:
                    NumberOrNull();
                    break;
            }
        }

        bool Next(char close)
        {
            char next = Peek();
            if (next == ',' || next == close) at++;
            return next != close;
        }

        char Peek()
        {
            while (at < end && (text[at] == ' ' || text[at] == '\n' || text[at] == '\r' || text[at] == '\t')) at++;
            return at < end ? (char)text[at] : '\0';
        }

        void Require(char expected)
        {
            if (Peek() != expected) throw Fault(expected.ToString());
            at++;
        }

        void Require(string word)
        {
            if (at + word.Length > end || !Holds(at, at + word.Length, word)) throw Fault(word);
            at += word.Length;
        }

        void SkipText(out int begin, out int stop)
        {
            Require('"');
            begin = at;
            while (at < end && text[at] != '"') at += text[at] == '\\' ? 2 : 1;
            stop = at;
            Require('"');
        }

        /// <summary>Whether the bytes are these letters of ASCII, without an escape.</summary>
        bool Holds(int begin, int stop, string expected)
        {
            if (stop - begin != expected.Length) return false;
            for (int i = 0; i < expected.Length; i++)
                if (text[begin + i] != expected[i] || text[begin + i] == '\\' || text[begin + i] > '~') return false;
            return true;
        }

        string Decoded(int begin, int stop)
        {
            string raw = Encoding.UTF8.GetString(text, begin, stop - begin);
            if (raw.IndexOf('\\') < 0) return raw;
            var found = new StringBuilder();
            for (int i = 0; i < raw.Length; i++)
            {
                if (raw[i] != '\\' || ++i == raw.Length) found.Append(raw[Math.Min(i, raw.Length - 1)]);
                else if (raw[i] == 'u' && i + 4 < raw.Length) found.Append((char)Convert.ToUInt16(raw.Substring((i += 4) - 3, 4), 16));
                else found.Append("nrtbf".IndexOf(raw[i]) < 0 ? raw[i] : "\n\r\t\b\f"["nrtbf".IndexOf(raw[i])]);
            }
            return found.ToString();
        }

        FormatException Fault(string expected)
        {
            string found = at < end ? Encoding.UTF8.GetString(text, at, Math.Min(20, end - at)) : "the end";
            return new FormatException("JSON should have " + expected + " at byte " + at + ", and has " + found);
        }
    }
}
